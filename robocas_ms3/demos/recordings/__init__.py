"""ManiSkill's trajectory files, written and strictly read, and their motion at a dataset's rate.

Whatever reads a file raises ``DatasetError`` if it is missing or damaged, or chooses what a file may not choose.
"""
