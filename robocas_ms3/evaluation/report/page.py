"""A result as a single HTML page without other files."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from robocas_ms3.core.text import format_count
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.html import (
    render_document,
    render_list,
    render_rate_bar,
    render_section,
    render_table,
)
from robocas_ms3.evaluation.report.tables import (
    Cell,
    FailureCount,
    Table,
    count_episodes,
    describe_action_noise,
    get_failure_name,
    get_stage_names,
    list_notes,
    make_tables,
    make_title,
    mean,
)
from robocas_ms3.evaluation.results.outcomes import Outcome
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.statistics import SuccessRate, compute_success_rate

VIDEOS = "videos"


def video_file_name(episode: int) -> str:
    """Return the file name of the video of the episode with this number."""
    return f"episode_{episode:05d}.mp4"


def render_page(result: Result, folder: Path | None = None, protocol: LoadedProtocol | None = None) -> str:
    """Return the report of a result as an HTML page.

    Args:
        result: the result.
        folder: folder of the page; videos in its folder ``videos`` are linked.
        protocol: protocol of the result; adds missing episodes, description and rules.
    """
    parts = [_render_lead(result, protocol)]
    if result.outcomes:
        success, *others = map(_render_table_section, make_tables(result))
        parts += [
            success,
            render_stages(result),
            *others,
            _render_seconds(result),
            _render_table_section(_make_effort_table(result)),
        ]
    parts += [_render_settings(result, protocol), _render_failed_episodes(result, folder)]
    return render_document(make_title(result), "".join(parts))


def _render_lead(result: Result, protocol: LoadedProtocol | None) -> str:
    count = len(result.outcomes)
    total = count if protocol is None else len(protocol.episodes)
    texts = [escape(note, quote=False) for note in list_notes(result)]
    if protocol is not None and count < total:
        missing = Counter(episode.config for episode in protocol.episodes if episode.episode not in result.outcomes)
        of = ", ".join(f"{many} of {escape(config)}" for config, many in missing.items())
        texts.append(f"Incomplete result: {format_count(missing.total(), 'episode')} of the protocol missing ({of}).")
    if broken := result.count_errors():
        texts.append(f"Ended by an error: {format_count(broken, 'episode')}, counted as failed.")
    lead = f"{count_episodes(result, protocol)}, protocol hash <code>{escape(result.run.protocol_hash[:16])}</code>."
    return f'<p class="lead">{lead}</p>\n' + "".join(f'<p class="note">{note}</p>\n' for note in texts)


def render_stages(result: Result) -> str:
    """Return the section with the stages of each configuration."""
    cards = []
    for config, outcomes in result.group_by("config").items():
        rows = []
        for stage, name in get_stage_names(outcomes[0].task).items():
            if any(stage in outcome.flags for outcome in outcomes):
                rate = result.compute_rate(stage, outcomes)
                shown = render_rate_bar(rate, "good" if stage == "success" else "")
                rows.append(
                    f'<div class="row"><span>{escape(name)}</span>{shown}<b>{100 * rate.rate:.0f} %</b></div>\n'
                )
        cards.append(f"<figure><figcaption>{escape(config)}, n {len(outcomes)}</figcaption>{''.join(rows)}</figure>\n")
    note = "Fraction of the episodes that reached each stage, with its interval. An episode may skip a stage."
    return render_section("Stages", note, f'<div class="cards">\n{"".join(cards)}</div>\n')


def _render_seconds(result: Result) -> str:
    taken = {
        config: [s for one in outcomes if one.success and (s := one.flag_seconds.get("success")) is not None]
        for config, outcomes in result.group_by("config").items()
    }
    if not any(taken.values()):
        return ""
    axis_end = _round_up(max(max(values, default=0.0) for values in taken.values()))
    rows = []
    for config, values in taken.items():
        cells = [f"{value:.1f}" for value in np.quantile(values, (0, 0.25, 0.5, 0.75, 1))] if values else [""] * 5
        rows.append(
            [escape(config), str(len(values)), *cells, _render_distribution(values, axis_end) if values else ""]
        )
    heads = ("configuration", "succeeded#", "min#", "25 %#", "median#", "75 %#", "max#", _render_axis(axis_end, "s"))
    note = "Simulated seconds of the successful episodes. A tick is an episode; the box contains half of them."
    return render_section("Seconds to success", note, render_table(heads, rows))


def _make_effort_table(result: Result) -> Table:
    rows = []
    for config, outcomes in result.group_by("config").items():

        def get_measures(name: str, outcomes: list[Outcome] = outcomes) -> list[float]:
            return [outcome.measures.get(name, np.nan) for outcome in outcomes]

        disturbed, fallen, n = get_measures("disturbed_most"), get_measures("fallen"), len(outcomes)
        rows.append(
            (
                *(config, compute_success_rate(sum(x > 0 for x in disturbed), n), f"{mean(disturbed):.2f}"),
                *(
                    compute_success_rate(sum(x > 0 for x in fallen), n),
                    f"{mean(fallen):.2f}",
                    f"{mean(get_measures('path_length')):.2f}",
                ),
                f"{np.median(get_measures('contact_impulse')):.1f}",
                f"{mean([outcome.inference_ms for outcome in outcomes]):.1f}",
            )
        )
    heads = (
        *("configuration", "any disturbed#", "disturbed, mean#", "any fallen#", "fallen, mean#"),
        *("path, mean m#", "impulse, median N s#", "policy, mean ms per step#"),
    )
    note = (
        "Disturbed: maximum number of objects (not the target) that were displaced by more than 3 cm or tipped over. "
        "Path: path length of the gripper. Impulse: contacts between gripper and objects. Policy: clock time."
    )
    return Table("Disturbance and effort", note, heads, rows)


def _render_settings(result: Result, protocol: LoadedProtocol | None) -> str:
    run, policy = result.run, result.run.policy
    pairs: list[tuple[str, object]] = [("protocol", run.protocol), ("protocol hash", run.protocol_hash)]
    if protocol is not None:
        names = {"rate_hz", "stepping", "max_steps", "max_seconds", "ends_on", "max_v0_steps"}
        rules = protocol.rules.model_dump(mode="json", include=names, exclude_none=True)
        pairs += [("description", protocol.description), ("rules", _to_text(rules))]
    entries = policy.model_dump(exclude_unset=True, exclude={"name"})
    pairs += [("policy", policy.name), *((f"policy, {name}", _to_text(value)) for name, value in entries.items())]
    pairs += [("RoboCAS-v0's weld", "yes" if run.weld else "no")]
    pairs += [("action noise", describe_action_noise(run) or "none")]
    pairs += [("played_as", _to_text(run.played_as))] if run.played_as else []
    pairs += [("backend", run.backend)]
    pairs += [
        ("versions", _to_text(run.versions)),
        *((f"pack {name}", hash_) for name, hash_ in run.pack_hashes.items()),
    ]
    machines = {_to_text(part.machine) for part in run.merged_from} or {_to_text(run.machine or {})}
    pairs += [("machine", machine) for machine in sorted(machines)]
    rows = [[escape(part.folder), str(part.episodes)] for part in run.merged_from]
    parts = render_table(("merged from", "episodes#"), rows) if rows else ""
    return render_section("Settings", "", render_list(pairs) + parts)


def _to_text(value: object) -> str:
    """Return a value as text: a dict as ``a 1, b 2``, a text unchanged, and other values as JSON."""
    if isinstance(value, dict):
        return ", ".join(
            f"{name} {json.dumps(inner) if isinstance(inner, dict) else _to_text(inner)}"
            for name, inner in value.items()
        )
    return value if isinstance(value, str) else json.dumps(value)


def _render_failed_episodes(result: Result, folder: Path | None) -> str:
    """Return the section of failed episodes with links to videos; empty without failures."""
    failed = [outcome for outcome in result.outcomes.values() if not outcome.success]
    if not failed:
        return ""
    filters = ""
    for label, column, values in (
        ("configuration", 1, {outcome.config for outcome in failed}),
        ("split", 3, {outcome.split for outcome in failed}),
        ("first stage not reached", 4, {get_failure_name(outcome.failure_stage) for outcome in failed}),
    ):
        options = "".join(f"<option>{escape(value)}</option>" for value in sorted(values))
        choices = f'<option value="">all</option>{options}'
        filters += f'<label>{label} <select data-column="{column}">{choices}</select></label>\n'
    rows = [_render_failed_episode(outcome, folder) for outcome in failed]
    heads = (
        *("episode#", "configuration", "seed#", "split", "first stage not reached", "ended by"),
        *("steps#", "s#", "p_vis#", "disturbed#", "error"),
    )
    linked = any("<a " in row[0] for row in rows)
    command = "<code>robocas eval videos RESULT --policy POLICY</code>"
    videos = "Linked numbers open videos." if linked else f"{command} records videos of some episodes."
    note = (
        f'<span id="count">{len(failed)}</span> of {format_count(len(result.outcomes), "episode")}. '
        f"Ended by: the time limit, a failure such as the target on the floor, or an error. {videos}"
    )
    table = render_table(heads, rows, "filtered") + '<p id="empty" hidden>No episodes match these filters.</p>\n'
    return render_section("Failed episodes", note, f'<form class="filters">{filters}</form>\n{table}')


def _render_failed_episode(outcome: Outcome, folder: Path | None) -> list[str]:
    video = f"{VIDEOS}/{video_file_name(outcome.episode)}"
    linked = folder is not None and (folder / video).is_file()
    return [
        f'<a href="{video}">{outcome.episode}</a>' if linked else str(outcome.episode),
        escape(outcome.config),
        str(outcome.seed),
        escape(outcome.split),
        escape(get_failure_name(outcome.failure_stage)),
        "error" if outcome.error else "failure" if outcome.flags.get("fail") is not None else "time",
        str(outcome.steps),
        f"{outcome.seconds:.1f}",
        "" if outcome.p_vis is None else f"{outcome.p_vis:.2f}",
        f"{outcome.measures.get('disturbed_most', 0):.0f}",
        escape(outcome.error),
    ]


def _render_table_section(table: Table) -> str:
    """Return the section of a table; rates have bars."""
    heads = []
    for head in map(escape, table.heads):
        heads += [f"{head[:-1]}#", "0 to 100 %"] if head.endswith("%") else [head]
    rows = [
        [html for cell, head in zip(row, table.heads, strict=True) for html in _render_cells(cell, head)]
        for row in table.rows
    ]
    return render_section(table.title, escape(table.note, quote=False), render_table(heads, rows))


def _render_distribution(values: Sequence[float], axis_end: float) -> str:
    """Return an SVG of a distribution on an axis from 0 to ``axis_end``: a tick per value, quartile box and median."""
    low, middle, high = (100 * np.quantile(values, (0.25, 0.5, 0.75)) / axis_end).tolist()
    ticks = "".join(f"M{100 * value / axis_end:.2f} 10V16" for value in values)
    return (
        '<svg class="bar" viewBox="0 0 100 16" preserveAspectRatio="none" role="img" aria-label="distribution">'
        f'<rect class="track" width="100" height="16"/><rect class="box" x="{low:.2f}" y="2" '
        f'width="{max(high - low, 0.3):.2f}" height="6"/><path class="tick" d="{ticks}"/>'
        f'<path class="median" d="M{middle:.2f} 1V9"/></svg>'
    )


def _render_axis(axis_end: float, unit: str) -> str:
    ends = [axis_end * part / 4 for part in range(5)]
    labels = "".join(f"<span>{end:g}{f' {unit}' if end == axis_end else ''}</span>" for end in ends)
    return f'<div class="axis">{labels}</div>'


def _round_up(value: float) -> float:
    """Round up to 1, 2, 4 or 8 times a power of ten, for the end of an axis."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(next(power * step for step in (1, 2, 4, 8, 10) if power * step >= value * (1 - 1e-9)))


def _render_cells(cell: Cell, head: str) -> list[str]:
    """Return the HTML cells of a value; a rate in a ``%`` column takes two cells: text and bar."""
    if isinstance(cell, SuccessRate):
        rate = f"{100 * cell.rate:.0f} %<small>{100 * cell.low:.0f} to {100 * cell.high:.0f}</small>"
        return [rate, render_rate_bar(cell, "good")] if head.endswith("%") else [rate]
    if isinstance(cell, FailureCount):
        return [f'<span class="heat" style="--fraction: {100 * cell.count / cell.n:.0f}%">{cell.count or ""}</span>']
    if cell is None:
        return ['<span class="faint">none</span>', *([""] if head.endswith("%") else [])]
    return [escape(cell)]
