"""What was done: ManiSkill's trajectory files, written and strictly read, and their motion at a dataset's rate."""
