"""The benchmark's tasks."""
