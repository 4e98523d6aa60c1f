"""Bits of HTML and SVG that the page is made of. Pictures have no text, so they may be stretched to any width."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from robocas_ms3.evaluation.statistics import Share


def section(title: str, said: str, content: str) -> str:
    """A part of the page: what it shows, how to read that, and the thing itself. All of it is HTML."""
    text = f"<p>{said}</p>\n" if said else ""
    return f"<section>\n<h2>{title}</h2>\n{text}{content}</section>\n"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table of cells that are HTML; a head that ends in ``#`` is that of numbers, which stand at the right."""
    right = ["number" if head.endswith("#") else "" for head in heads]
    head = "".join(_cell("th", name.rstrip("#"), how) for name, how in zip(heads, right, strict=True))
    body = "".join(
        "<tr>" + "".join(_cell("td", cell, how) for cell, how in zip(row, right, strict=True)) + "</tr>\n"
        for row in rows
    )
    kinds = f' class="{kind}"' if kind else ""
    return f'<div class="wide"><table{kinds}><thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>\n'


def rate(share: Share | None) -> str:
    """A share and its interval in two lines."""
    if share is None:
        return '<span class="faint">none</span>'
    return f"{100 * share.rate:.0f} %<small>{100 * share.low:.0f} to {100 * share.high:.0f}</small>"


def bar(share: Share | None, kind: str = "") -> str:
    """A bar of 0..100 % with its interval."""
    if share is None:
        return ""
    low, high, here = 100 * share.low, 100 * share.high, 100 * share.rate
    said = f"{share.k} of {share.n}: {here:.1f} %, {low:.1f} to {high:.1f}"
    return (
        f'<svg class="bar {kind}" viewBox="0 0 100 16" preserveAspectRatio="none" role="img" aria-label="{said}">'
        f'<title>{said}</title><rect class="track" width="100" height="16"/>'
        f'<rect class="fill" y="2" width="{here:.2f}" height="12"/>'
        f'<path class="whisker" d="M{low:.2f} 8H{high:.2f}M{low:.2f} 4V12M{high:.2f} 4V12"/></svg>'
    )


def spread(values: Sequence[float], most: float) -> str:
    """Where numbers lie in 0..most: a tick each, a box from the lower to the upper quartile, a line at the median."""
    low, middle, high = (100 * np.quantile(values, (0.25, 0.5, 0.75)) / most).tolist()
    ticks = "".join(f"M{100 * value / most:.2f} 10V16" for value in values)
    return (
        '<svg class="bar" viewBox="0 0 100 16" preserveAspectRatio="none" role="img" aria-label="distribution">'
        f'<rect class="track" width="100" height="16"/><rect class="box" x="{low:.2f}" y="2" '
        f'width="{max(high - low, 0.3):.2f}" height="6"/><path class="tick" d="{ticks}"/>'
        f'<path class="median" d="M{middle:.2f} 1V9"/></svg>'
    )


def axis(most: float, unit: str, parts: int = 4) -> str:
    """What a bar's width means."""
    ends = [most * part / parts for part in range(parts + 1)]
    said = "".join(f"<span>{end:g}{f' {unit}' if end == most else ''}</span>" for end in ends)
    return f'<div class="axis">{said}</div>'


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """A list of what is what, of plain text."""
    said = "".join(f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>\n" for name, value in pairs)
    return f"<dl>\n{said}</dl>\n"


def round_up(value: float) -> float:
    """A number of 1, 2, 4 or 8 times a power of ten that is no smaller, for the end of an axis."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(next(power * step for step in (1, 2, 4, 8, 10) if power * step >= value * (1 - 1e-9)))


def _cell(tag: str, content: str, kind: str) -> str:
    return f'<{tag} class="{kind}">{content}</{tag}>' if kind else f"<{tag}>{content}</{tag}>"
