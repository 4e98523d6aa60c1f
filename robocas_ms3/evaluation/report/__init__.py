"""Reports of a result: ``report.md``, ``report.html``, and ``episodes.parquet`` for notebooks."""

from __future__ import annotations

import importlib.util
from dataclasses import asdict
from pathlib import Path

from robocas_ms3.core.files import atomic_file, make_folder
from robocas_ms3.core.text import escape_controls
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.page import render_page
from robocas_ms3.evaluation.report.tables import render_markdown
from robocas_ms3.evaluation.results.result_files import Result

MARKDOWN, PAGE, PARQUET = "report.md", "report.html", "episodes.parquet"
_COLUMNS = {
    "int64": ("episode", "seed", "steps"),
    "string": ("task", "config", "split", "failure_stage", "error"),
    "bool_": ("success", "success_at_end", "success_v0"),
    "float64": ("seconds", "inference_ms", "p_vis"),
}
_NESTED = {"flags": "int64", "flag_seconds": "float64", "measures": "float64"}  # flags.success and so on


def write_report(result: Result, folder: Path, protocol: LoadedProtocol | None = None) -> list[Path]:
    """Write ``report.md``, ``report.html`` and, if pyarrow is installed, ``episodes.parquet``; return their paths.

    Args:
        result: the result.
        folder: output folder; the page links the videos in its folder ``videos``.
        protocol: protocol of the result; adds its number of episodes, and to the page the missing episodes.
    """
    make_folder(folder)
    written = []
    for name, text in ((MARKDOWN, render_markdown(result, protocol)), (PAGE, render_page(result, folder, protocol))):
        written.append(folder / name)
        with atomic_file(folder / name) as tmp:
            tmp.write_text(escape_controls(text, lines=True), encoding="utf-8")
    if importlib.util.find_spec("pyarrow") is not None:
        written.append(folder / PARQUET)
        with atomic_file(folder / PARQUET) as tmp:
            write_parquet(result, tmp)
    return written


def write_parquet(result: Result, path: Path) -> None:
    """Write a result as a Parquet file with a row per episode; columns have the names and units of `Outcome`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [asdict(outcome) for outcome in result.outcomes.values()]
    columns = {
        name: pa.array([row[name] for row in rows], getattr(pa, kind)())
        for kind, names in _COLUMNS.items()
        for name in names
    }
    for outer, kind in _NESTED.items():
        for name in dict.fromkeys(name for row in rows for name in row[outer]):
            columns[f"{outer}.{name}"] = pa.array([row[outer].get(name) for row in rows], getattr(pa, kind)())
    orders = [outcome.retrieval for outcome in result.outcomes.values()]
    if any(orders):
        for name, kind in (("score", "float64"), ("moved", "int64"), ("left", "int64")):
            values = [None if order is None else getattr(order, name) for order in orders]
            values = [len(value) if isinstance(value, list) else value for value in values]
            columns[f"retrieval.{name}"] = pa.array(values, getattr(pa, kind)())
    pq.write_table(pa.table(columns), path)
