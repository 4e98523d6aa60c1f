"""Scenes: task configurations, layouts of objects, instructions, and building a scene in a simulator."""
