"""What is in a dataset, counted and drawn."""
