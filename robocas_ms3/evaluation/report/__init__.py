"""A result for people: ``report.md``, ``report.html``, and ``episodes.parquet`` for their notebooks."""

from __future__ import annotations

import importlib.util
from dataclasses import asdict
from pathlib import Path

from robocas_ms3.core.files import make_folder, replacing
from robocas_ms3.core.words import printable
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.page import page
from robocas_ms3.evaluation.report.tables import markdown
from robocas_ms3.evaluation.results import Result

MARKDOWN, PAGE, PARQUET = "report.md", "report.html", "episodes.parquet"
_TEXTS = ("task", "config", "split", "failure_stage", "error")
_TRUTHS = ("success", "success_at_end", "success_v0")
_WHOLE = ("episode", "seed", "steps")
_REAL = ("seconds", "inference_ms", "p_vis")
_INSIDE = {"flags": "int64", "flag_seconds": "float64", "measures": "float64"}  # flags.success and so on


def write_report(result: Result, folder: Path, protocol: LoadedProtocol | None = None) -> list[Path]:
    """Write a result's tables, page and columns; the last only where pyarrow is installed.

    Args:
        result: of which.
        folder: that they come into; the page links videos that lie in its ``videos``.
        protocol: that it was measured by, if it is at hand; the page then tells how many episodes are missing.

    Returns:
        The files.
    """
    make_folder(folder)
    written = []
    for name, text in ((MARKDOWN, markdown(result)), (PAGE, page(result, folder, protocol))):
        written.append(folder / name)
        with replacing(folder / name) as tmp:
            tmp.write_text(printable(text, lines=True), encoding="utf-8")
    if importlib.util.find_spec("pyarrow") is not None:
        written.append(folder / PARQUET)
        with replacing(folder / PARQUET) as tmp:
            write_parquet(result, tmp)
    return written


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
