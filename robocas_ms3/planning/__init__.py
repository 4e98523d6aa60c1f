"""Motion planning: the planner protocol and its backends, skills, and one scripted solver a task."""
