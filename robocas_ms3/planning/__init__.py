"""Motion planning: planner protocol and backends, skills, and one scripted policy (solver) per task."""
