"""Parts of HTML pages without other files.

The SVG images contain no text, so they can be stretched.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files

from robocas_ms3.evaluation.statistics import SuccessRate


def render_document(title: str, content: str) -> str:
    """Return an HTML page with the style and the script of reports.

    Args:
        title: title in plain text.
        content: HTML below the title.
    """
    here = files("robocas_ms3.evaluation.report")
    style, script = ((here / name).read_text(encoding="utf-8") for name in ("style.css", "script.js"))
    title = escape(title)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
        f"{content}</main>\n<script>\n{script}</script>\n</body>\n</html>\n"
    )


def render_section(title: str, note: str, content: str) -> str:
    """Return a section; note and content are HTML."""
    text = f"<p>{note}</p>\n" if note else ""
    return f"<section>\n<h2>{title}</h2>\n{text}{content}</section>\n"


def render_table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Return an HTML table; cells are HTML, and columns whose head ends with ``#`` are aligned to the right."""
    right = ["number" if head.endswith("#") else "" for head in heads]
    head = "".join(_render_tag("th", name.rstrip("#"), how) for name, how in zip(heads, right, strict=True))
    body = "".join(
        "<tr>" + "".join(_render_tag("td", cell, how) for cell, how in zip(row, right, strict=True)) + "</tr>\n"
        for row in rows
    )
    kinds = f' class="{kind}"' if kind else ""
    return f'<div class="wide"><table{kinds}><thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>\n'


def render_rate_bar(rate: SuccessRate, kind: str = "") -> str:
    """Return an SVG bar of a success rate and its interval, on an axis of 0 to 100 %."""
    low, high, here = 100 * rate.low, 100 * rate.high, 100 * rate.rate
    label = f"{rate.k} of {rate.n}: {here:.1f} %, {low:.1f} to {high:.1f}"
    return (
        f'<svg class="bar {kind}" viewBox="0 0 100 16" preserveAspectRatio="none" role="img" aria-label="{label}">'
        f'<title>{label}</title><rect class="track" width="100" height="16"/>'
        f'<rect class="fill" y="2" width="{here:.2f}" height="12"/>'
        f'<path class="whisker" d="M{low:.2f} 8H{high:.2f}M{low:.2f} 4V12M{high:.2f} 4V12"/></svg>'
    )


def render_list(pairs: Iterable[tuple[str, object]]) -> str:
    """Return an HTML definition list of names and values, which are plain text."""
    entries = "".join(f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>\n" for name, value in pairs)
    return f"<dl>\n{entries}</dl>\n"


def _render_tag(tag: str, content: str, kind: str) -> str:
    return f'<{tag} class="{kind}">{content}</{tag}>' if kind else f"<{tag}>{content}</{tag}>"
