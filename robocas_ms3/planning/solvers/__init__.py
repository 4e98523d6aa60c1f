"""Scripted policies: one solver per task."""
