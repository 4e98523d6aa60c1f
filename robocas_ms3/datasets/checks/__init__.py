"""What is wrong with a dataset: functions from content to violations."""
