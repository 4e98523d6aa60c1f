"""Frozen protocols: their episodes and layouts, the bundled ones, and the difficulty of their scenes.

`protocol` reads and checks them, `freeze` makes them from a source file.
"""
