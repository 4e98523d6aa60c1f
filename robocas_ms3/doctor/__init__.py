"""Checks of an installation: each check that may crash runs in a child process."""
