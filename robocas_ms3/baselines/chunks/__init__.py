"""Chunks of TCP poses: what `small` and `bc-state` predict, are trained by and act by."""
