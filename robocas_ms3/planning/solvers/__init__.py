"""Scripted policies: one solver a task."""
