"""Scenes: layouts as pure maths, and building them in a simulator."""
