"""Errors, files and output folders, validation, registries, poses, and processes that do work."""
