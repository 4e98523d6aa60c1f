"""Images of a dataset: their files, and what is drawn of them for people."""
