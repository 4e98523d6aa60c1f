"""``robocas view``: a viewer of trajectory files and datasets in a browser."""
