"""Policies that are trained: a folder per baseline, `training` for the trainer, `chunks` for what several predict."""
