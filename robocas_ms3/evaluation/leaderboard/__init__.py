"""Leaderboard: one JSON file with a row per policy, protocol, task and split.

`rows` defines the file, `result_rows` makes rows from results, and `markdown` renders the rows as tables.
"""
