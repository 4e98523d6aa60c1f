"""Results of evaluations: the record of the run, outcomes, metrics, stored actions and checkpoints.

`result_files` reads and writes them, `verify` checks that they are consistent.
"""
