"""Conversion of recordings to RoboCAS folders."""
