"""Generate large datasets from a plan: executors run its work units, whose episodes are joined into one dataset.

`load.py` reads a plan, `run.py` passes its work units to one of `executors/`, `join.py` joins the episodes.
"""
