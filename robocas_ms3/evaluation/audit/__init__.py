"""Audit of a result: replay the stored actions in the frozen scenes, and compare outcomes and checkpoints.

An audit shows that the stored actions have the recorded outcomes; on another processor, only within tolerances. It does
not show which policy chose the actions. Neither the policy nor a renderer is needed.
"""
