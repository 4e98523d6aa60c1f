"""Outcomes as a Parquet table, a row an episode."""

from __future__ import annotations

import importlib.util
from dataclasses import asdict
from pathlib import Path

from robocas_ms3.evaluation.results import Result

_TEXTS = ("task", "config", "split", "failure_stage", "error")
_TRUTHS = ("success", "success_at_end", "success_v0")
_WHOLE = ("episode", "seed", "steps")
_REAL = ("seconds", "inference_ms", "p_vis")
_INSIDE = {"flags": "int64", "flag_seconds": "float64", "measures": "float64"}  # flags.success and so on


def has_parquet() -> bool:
    """Whether what writes Parquet is installed."""
    return importlib.util.find_spec("pyarrow") is not None


def write_parquet(result: Result, path: Path) -> None:
    """Write a table of a result; its columns have the names and units of `Outcome`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [asdict(outcome) for outcome in result.outcomes.values()]
    columns = {}
    for names, kind in ((_WHOLE, pa.int64()), (_TEXTS, pa.string()), (_TRUTHS, pa.bool_()), (_REAL, pa.float64())):
        for name in names:
            columns[name] = pa.array([row[name] for row in rows], kind)
    for outer, kind in _INSIDE.items():
        for name in dict.fromkeys(name for row in rows for name in row[outer]):
            columns[f"{outer}.{name}"] = pa.array([row[outer].get(name) for row in rows], kind)
    orders = [row["retrieval"] or {} for row in rows]
    if any(orders):
        moved = [None if not order else len(order["moved"]) for order in orders]
        columns["retrieval.score"] = pa.array([order.get("score") for order in orders], pa.float64())
        columns["retrieval.moved"] = pa.array(moved, pa.int64())
        columns["retrieval.left"] = pa.array([order.get("left") for order in orders], pa.int64())
    pq.write_table(pa.table(columns), path)
