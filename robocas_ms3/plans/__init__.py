"""Datasets of any size from a plan: work units that any executor does, joined into one dataset.

`load.py` reads a plan, `run.py` has its work units done by one of `executors/`, `join.py` joins their episodes.
"""
