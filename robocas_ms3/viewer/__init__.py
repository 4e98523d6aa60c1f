"""`robocas view`: trajectories and datasets in a browser, served on this machine or written as a folder."""
