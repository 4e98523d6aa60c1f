"""Merging and splitting of datasets, and import of the format of RoboCAS-v0."""
