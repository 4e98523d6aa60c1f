"""A result for people: ``report.md``, ``report.html``, and ``episodes.parquet`` for their notebooks."""

from __future__ import annotations

from pathlib import Path

from robocas_ms3.core.files import make_folder, replacing
from robocas_ms3.core.words import printable
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.columns import has_parquet, write_parquet
from robocas_ms3.evaluation.report.page import page
from robocas_ms3.evaluation.results import Result
from robocas_ms3.evaluation.tables import markdown

MARKDOWN, PAGE, PARQUET = "report.md", "report.html", "episodes.parquet"


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
    if has_parquet():
        written.append(folder / PARQUET)
        with replacing(folder / PARQUET) as tmp:
            write_parquet(result, tmp)
    return written
