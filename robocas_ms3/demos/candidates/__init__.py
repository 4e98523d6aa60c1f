"""Candidates of decisions: propose them, simulate each one in a forked process, and store their outcomes.

`schema` defines the file ``candidates.h5``, `records` has the values of one decision before they are written, and
`candidates_file` writes, merges and reads the file.
"""
