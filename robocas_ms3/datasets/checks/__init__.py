"""Checks of RoboCAS folders: functions that take content and yield violations."""
