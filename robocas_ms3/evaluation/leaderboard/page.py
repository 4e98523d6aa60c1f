"""Leaderboard as a single HTML page with filters, and the stages of each result."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from markdown_it import MarkdownIt

from robocas_ms3.evaluation.audit.run import hash_result
from robocas_ms3.evaluation.leaderboard.entries import find_card, get_entry_name, read_card
from robocas_ms3.evaluation.leaderboard.markdown import (
    PUBLISHED_NOTE,
    RANK_NOTE,
    describe_cost,
    describe_data,
    describe_skipped,
    format_audited,
    list_row_notes,
)
from robocas_ms3.evaluation.leaderboard.rows import LeaderboardRow, Training
from robocas_ms3.evaluation.report.html import render_document, render_rate_bar, render_section, render_table
from robocas_ms3.evaluation.report.page import VIDEOS, render_stages
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.statistics import compute_success_rate

NOTE = (
    f"Success rates with exact 95 % intervals. {RANK_NOTE} p: adjusted p-value of the comparison with the next ranked "
    "policy. An audit shows that the stored actions have these outcomes, but not which policy chose them. Policy, "
    "track, camera calibration, training data, training and parameters are statements of the author."
)
_HEADS = (
    *("policy", "rank#", "success#", "0 to 100 %", "n#", "audited#", "p#", "protocol", "task", "split", "track"),
    *("training data matches", "training data", "training", "parameters#", "notes"),
)
_FILTERS = ("protocol", "task", "split", "track", "policy", "training data matches", "training data")


def render_leaderboard_page(
    rows: Sequence[LeaderboardRow], results: Sequence[Result], folder: Path, skipped: Sequence[str] = ()
) -> str:
    """Return the leaderboard as an HTML page.

    Args:
        rows: rows in the order of the page.
        results: results of the entries.
        folder: folder of the page; videos in `video_folder` are linked.
        skipped: names of the results that are not shown because of a problem.
    """
    measured = [_render_row(row) for row in rows if not row.published]
    table = render_table(_HEADS, measured, "filtered")
    empty = '<p id="empty" hidden>No rows match these filters.</p>\n'
    note = f'<p class="note">{escape(describe_skipped(skipped))}</p>\n' if skipped else ""
    head = f'<span id="count">{len(measured)}</span> of {len(measured)} rows. {escape(NOTE, quote=False)}'
    parts = [render_section("Results", head, note + _render_filters(measured) + table + empty)]
    entries: dict[Path, list[Result]] = {}
    for result in results:
        entries.setdefault(result.folder.parent, []).append(result)
    content = "".join(_render_entry(found, rows, folder) for found in entries.values())
    parts.append(render_section("Entries", "Stages, videos and model card of each entry.", content))
    if published := [row for row in rows if row.published]:
        heads = ("policy", "track", "task", "success by RoboCAS-v0's rule#")
        cells = [[escape(x) for x in (row.policy, row.track, row.task, _format_published(row))] for row in published]
        parts.append(
            render_section("Published results", escape(PUBLISHED_NOTE, quote=False), render_table(heads, cells))
        )
    return render_document("RoboCAS leaderboard", "".join(parts))


def video_folder(folder: Path, result: Result) -> Path:
    """Return the folder of the videos of a result, next to the page in ``folder``; each result has its own."""
    names = get_entry_name(result.folder), result.folder.name, hash_result(result)[:8]  # no names from the result
    return folder.joinpath(VIDEOS, *names)


def _render_filters(rows: Sequence[Sequence[str]]) -> str:
    labels = []
    for name in _FILTERS:
        column = _HEADS.index(name)
        values = {row[column].partition("<small>")[0] for row in rows} - {""}
        options = "".join(f"<option>{value}</option>" for value in sorted(values))
        choices = f'<option value="">all</option>{options}'
        selection = f'<select data-column="{column}" data-name="{name}">{choices}</select>'
        labels.append(f"<label>{name} {selection}</label>\n")
    return f'<form class="filters">{"".join(labels)}</form>\n'


def _render_row(row: LeaderboardRow) -> list[str]:
    training, rate = row.training or Training(), compute_success_rate(row.successes or 0, row.n or 1)
    where = escape(", ".join((row.protocol, row.task, row.split)))
    return [
        f"{escape(row.name)}<small>{where}</small>",  # the small text is shown on small screens only
        "" if row.rank is None else str(row.rank),
        f"{100 * rate.rate:.1f} %<small>{100 * rate.low:.1f} to {100 * rate.high:.1f}</small>",
        render_rate_bar(rate, "good"),
        str(rate.n),
        format_audited(row),
        "" if row.rank_p_value is None else f"{row.rank_p_value:.2g}",
        *map(escape, (row.protocol, row.task, row.split, row.track)),
        "" if row.training_matches is None else "yes" if row.training_matches else "no",
        escape(describe_data(training)),
        escape(describe_cost(training)),
        "" if row.parameters is None else f"{row.parameters / 1e6:.2f} M",
        escape("; ".join(list_row_notes(row))),
    ]


def _render_entry(results: Sequence[Result], rows: Sequence[LeaderboardRow], folder: Path) -> str:
    """Return the results of an entry and its model card, folded."""
    name, card = get_entry_name(results[0].folder), find_card(results[0].folder)
    parts = [_render_result(result, rows, folder) for result in results]
    if card.is_file():
        parts.append(_render_card(read_card(card)))
    return f'<details class="entry">\n<summary>{escape(name)}</summary>\n{"".join(parts)}</details>\n'


def _render_result(result: Result, rows: Sequence[LeaderboardRow], folder: Path) -> str:
    """Return the stages of a result, and links to its videos, folded."""
    entry, protocol = get_entry_name(result.folder), result.run.protocol
    policy = next((row.name for row in rows if (row.entry, row.protocol) == (entry, protocol)), entry)
    videos = sorted(video_folder(folder, result).glob("*.mp4"))
    links = " ".join(f'<a href="{escape(one.relative_to(folder).as_posix())}">{one.stem}</a>' for one in videos)
    shown = f"<p>Videos of failed episodes: {links}</p>\n" if videos else ""
    names = f'data-policy="{escape(policy)}" data-protocol="{escape(protocol)}"'  # the filters read them
    return f"<details {names}>\n<summary>{escape(protocol)}</summary>\n{render_stages(result)}{shown}</details>\n"


def _render_card(text: str) -> str:
    """Return a model card as HTML; HTML and images in the card are shown as text."""
    markdown = MarkdownIt("js-default").disable("image")
    tokens = markdown.parse(text)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{min(int(token.tag[1]) + 2, 6)}"  # below the heading of the section
    return f'<div class="card">\n{markdown.renderer.render(tokens, markdown.options, {})}</div>\n'


def _format_published(row: LeaderboardRow) -> str:
    rate = row.rate_v0 if row.rate is None else row.rate
    return "" if rate is None else f"{100 * rate:.1f} %"
