"""Parts of HTML and SVG that the page is made of. SVG has no text, so it may be stretched to any width."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from robocas_ms3.evaluation.report.tables import Cell, Fraction, Table
from robocas_ms3.evaluation.statistics import Share


def section(title: str, note: str, content: str) -> str:
    """Return a section of the page; note and content are HTML."""
    text = f"<p>{note}</p>\n" if note else ""
    return f"<section>\n<h2>{title}</h2>\n{text}{content}</section>\n"


def table_section(table: Table) -> str:
    """Return the section of a table, in which rates have bars."""
    heads = []
    for head in map(escape, table.heads):
        heads += [f"{head[:-1]}#", "0 to 100 %"] if head.endswith("%") else [head]
    rows = [
        [html for cell, head in zip(row, table.heads, strict=True) for html in _cells(cell, head)] for row in table.rows
    ]
    return section(table.title, escape(table.note, quote=False), html_table(heads, rows))


def html_table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Return a table of cells that are HTML; a head that ends in ``#`` is that of numbers, which are at the right."""
    right = ["number" if head.endswith("#") else "" for head in heads]
    head = "".join(_tag("th", name.rstrip("#"), how) for name, how in zip(heads, right, strict=True))
    body = "".join(
        "<tr>" + "".join(_tag("td", cell, how) for cell, how in zip(row, right, strict=True)) + "</tr>\n"
        for row in rows
    )
    kinds = f' class="{kind}"' if kind else ""
    return f'<div class="wide"><table{kinds}><thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>\n'


def bar(share: Share, kind: str = "") -> str:
    """Return a bar of 0..100 % with its interval."""
    low, high, here = 100 * share.low, 100 * share.high, 100 * share.rate
    label = f"{share.k} of {share.n}: {here:.1f} %, {low:.1f} to {high:.1f}"
    return (
        f'<svg class="bar {kind}" viewBox="0 0 100 16" preserveAspectRatio="none" role="img" aria-label="{label}">'
        f'<title>{label}</title><rect class="track" width="100" height="16"/>'
        f'<rect class="fill" y="2" width="{here:.2f}" height="12"/>'
        f'<path class="whisker" d="M{low:.2f} 8H{high:.2f}M{low:.2f} 4V12M{high:.2f} 4V12"/></svg>'
    )


def spread(values: Sequence[float], most: float) -> str:
    """Return where numbers are in 0..most: a tick each, a box from the lower to the upper quartile, and the median."""
    low, middle, high = (100 * np.quantile(values, (0.25, 0.5, 0.75)) / most).tolist()
    ticks = "".join(f"M{100 * value / most:.2f} 10V16" for value in values)
    return (
        '<svg class="bar" viewBox="0 0 100 16" preserveAspectRatio="none" role="img" aria-label="distribution">'
        f'<rect class="track" width="100" height="16"/><rect class="box" x="{low:.2f}" y="2" '
        f'width="{max(high - low, 0.3):.2f}" height="6"/><path class="tick" d="{ticks}"/>'
        f'<path class="median" d="M{middle:.2f} 1V9"/></svg>'
    )


def axis(most: float, unit: str) -> str:
    """Return the labels of a bar's width."""
    ends = [most * part / 4 for part in range(5)]
    labels = "".join(f"<span>{end:g}{f' {unit}' if end == most else ''}</span>" for end in ends)
    return f'<div class="axis">{labels}</div>'


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """Return a list of names and values, which are plain text."""
    entries = "".join(f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>\n" for name, value in pairs)
    return f"<dl>\n{entries}</dl>\n"


def round_up(value: float) -> float:
    """Return 1, 2, 4 or 8 times a power of ten that is no smaller, for the end of an axis."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(next(power * step for step in (1, 2, 4, 8, 10) if power * step >= value * (1 - 1e-9)))


def _cells(cell: Cell, head: str) -> list[str]:
    """Return the HTML of a cell: a rate with a bar is two."""
    if isinstance(cell, Share):
        rate = f"{100 * cell.rate:.0f} %<small>{100 * cell.low:.0f} to {100 * cell.high:.0f}</small>"
        return [rate, bar(cell, "good")] if head.endswith("%") else [rate]
    if isinstance(cell, Fraction):
        return [f'<span class="heat" style="--share: {100 * cell.count / cell.n:.0f}%">{cell.count or ""}</span>']
    if cell is None:
        return ['<span class="faint">none</span>', *([""] if head.endswith("%") else [])]
    return [escape(cell)]


def _tag(tag: str, content: str, kind: str) -> str:
    return f'<{tag} class="{kind}">{content}</{tag}>' if kind else f"<{tag}>{content}</{tag}>"
