"""Datasets made of others: merging, splitting, importing from the format of RoboCAS-v0."""
