"""Sources of episodes: trajectory files and dataset folders, with one interface."""
