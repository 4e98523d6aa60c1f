"""Policies that learn from demonstrations: a folder each, one trainer, and runs that `robocas eval` measures."""
