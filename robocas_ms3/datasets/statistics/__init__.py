"""Statistics of a dataset and their plots."""
