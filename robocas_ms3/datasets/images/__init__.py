"""Images of a dataset: files, videos and contact sheets."""
