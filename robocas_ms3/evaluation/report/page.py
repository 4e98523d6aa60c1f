"""A result as one HTML page that needs no other file."""

from __future__ import annotations

import json
from collections import Counter
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from robocas_ms3.core.words import count_of
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.html import axis, bar, facts, html_table, round_up, section, spread, table_section
from robocas_ms3.evaluation.report.tables import WELDED, Table, failure_name, mean, stages_of, tables
from robocas_ms3.evaluation.report.tables import title as title_of
from robocas_ms3.evaluation.results import Result
from robocas_ms3.evaluation.statistics import share

VIDEOS = "videos"


def video_name(episode: int) -> str:
    """Return the name of the file in ``videos``."""
    return f"episode_{episode:05d}.mp4"


def page(result: Result, folder: Path | None = None, protocol: LoadedProtocol | None = None) -> str:
    """Return the page of a result, for a folder that may have ``videos``; see `write_report`."""
    here = files("robocas_ms3.evaluation.report")
    style, script = ((here / name).read_text(encoding="utf-8") for name in ("style.css", "script.js"))
    title, parts = escape(title_of(result)), [_lead(result, protocol)]
    if result.outcomes:
        success, *others = map(table_section, tables(result))
        parts += [success, _funnels(result), *others, _seconds(result), table_section(_effort(result))]
    parts += [_record(result, protocol), _failed_episodes(result, folder)]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
        f"{''.join(parts)}</main>\n<script>\n{script}</script>\n</body>\n</html>\n"
    )


def _lead(result: Result, protocol: LoadedProtocol | None) -> str:
    count = len(result.outcomes)
    total = count if protocol is None else len(protocol.episodes)
    episodes = count_of(count, "episode") if protocol is None else f"{count} of {count_of(total, 'episode')}"
    notes = [WELDED] if result.run.weld else []
    if protocol is not None and count < total:
        missing = Counter(episode.config for episode in protocol.episodes if episode.episode not in result.outcomes)
        of = ", ".join(f"{many} of {escape(config)}" for config, many in missing.items())
        notes.append(
            f"Missing of the protocol: {count_of(missing.total(), 'episode')} ({of}). This is no whole result."
        )
    if broken := result.broken_off():
        notes.append(f"Broken off by an error: {count_of(broken, 'episode')}, counted as failed.")
    lead = f"{episodes}, protocol hash <code>{escape(result.run.protocol_hash[:16])}</code>."
    return f'<p class="lead">{lead}</p>\n' + "".join(f'<p class="note">{note}</p>\n' for note in notes)


def _funnels(result: Result) -> str:
    cards = []
    for config, outcomes in result.by("config").items():
        rows = []
        for stage, name in stages_of(outcomes[0].task).items():
            if any(stage in outcome.flags for outcome in outcomes):
                rate = result.rate(stage, outcomes)
                shown = bar(rate, "good" if stage == "success" else "")
                rows.append(
                    f'<div class="row"><span>{escape(name)}</span>{shown}<b>{100 * rate.rate:.0f} %</b></div>\n'
                )
        cards.append(f"<figure><figcaption>{escape(config)}, n {len(outcomes)}</figcaption>{''.join(rows)}</figure>\n")
    note = "Share of the episodes that reached each stage, with its interval. An episode may skip a stage."
    return section("Stages", note, f'<div class="cards">\n{"".join(cards)}</div>\n')


def _seconds(result: Result) -> str:
    taken = {
        config: [s for one in outcomes if (s := one.flag_seconds.get("success")) is not None]
        for config, outcomes in result.by("config").items()
    }
    if not any(taken.values()):
        return ""
    most = round_up(max(max(values, default=0.0) for values in taken.values()))
    rows = []
    for config, values in taken.items():
        cells = [f"{value:.1f}" for value in np.quantile(values, (0, 0.25, 0.5, 0.75, 1))] if values else [""] * 5
        rows.append([escape(config), str(len(values)), *cells, spread(values, most) if values else ""])
    heads = ("configuration", "succeeded#", "least#", "25 %#", "median#", "75 %#", "most#", axis(most, "s"))
    note = "Simulated seconds, over the episodes that succeeded. A tick is an episode, the box half of them."
    return section("Seconds to success", note, html_table(heads, rows))


def _effort(result: Result) -> Table:
    rows = []
    for config, outcomes in result.by("config").items():

        def of(name: str, outcomes: list[Outcome] = outcomes) -> list[float]:
            return [outcome.measures.get(name, np.nan) for outcome in outcomes]

        disturbed, fallen, n = of("disturbed_most"), of("fallen"), len(outcomes)
        rows.append(
            (
                *(config, share(sum(x > 0 for x in disturbed), n), f"{mean(disturbed):.2f}"),
                *(share(sum(x > 0 for x in fallen), n), f"{mean(fallen):.2f}", f"{mean(of('path_length')):.2f}"),
                f"{np.median(of('contact_impulse')):.1f}",
                f"{mean([outcome.inference_ms for outcome in outcomes]):.1f}",
            )
        )
    heads = (
        *("configuration", "any disturbed#", "disturbed, mean#", "any fallen#", "fallen, mean#"),
        *("path, mean m#", "impulse, median N s#", "policy, mean ms per step#"),
    )
    note = (
        "Disturbed: objects other than the target more than 3 cm from where they were, or tipped, at the worst step. "
        "Path is the gripper's. Impulse is of contacts between gripper and objects. The policy's time is clock time."
    )
    return Table("Disturbance and effort", note, heads, rows)


def _record(result: Result, protocol: LoadedProtocol | None) -> str:
    run, policy = result.run, result.run.policy
    pairs: list[tuple[str, object]] = [("protocol", run.protocol), ("its hash", run.protocol_hash)]
    if protocol is not None:
        names = {"rate_hz", "stepping", "max_steps", "max_seconds", "ends_on", "max_v0_steps"}
        rules = protocol.rules.model_dump(mode="json", include=names, exclude_none=True)
        pairs += [("what it says", protocol.rules.description), ("its rules", _plain(rules))]
    entries = policy.model_dump(exclude_unset=True, exclude={"name"})
    pairs += [("policy", policy.name), *((f"policy, {name}", _plain(value)) for name, value in entries.items())]
    pairs += [("upstream's weld", "yes" if run.weld else "no"), ("backend", run.backend)]
    pairs += [("versions", _plain(run.versions)), *((f"pack {name}", hash_) for name, hash_ in run.pack_hashes.items())]
    machines = {_plain(part.machine) for part in run.parts} or {_plain(run.machine or {})}
    pairs += [("machine", machine) for machine in sorted(machines)]
    rows = [[escape(part.folder), str(part.episodes)] for part in run.parts]
    parts = html_table(("part", "episodes#"), rows) if rows else ""
    return section("What it was measured with", "", facts(pairs) + parts)


def _plain(value: object) -> str:
    """Return a dictionary as ``a 1, b 2``; anything else as JSON, texts as they are."""
    if isinstance(value, dict):
        return ", ".join(
            f"{name} {json.dumps(inner) if isinstance(inner, dict) else _plain(inner)}" for name, inner in value.items()
        )
    return value if isinstance(value, str) else json.dumps(value)


def _failed_episodes(result: Result, folder: Path | None) -> str:
    """Return the list of failed episodes, whose numbers link to videos; empty if none failed."""
    failed = [outcome for outcome in result.outcomes.values() if not outcome.success]
    if not failed:
        return ""
    filters = ""
    for label, column, values in (
        ("configuration", 1, {outcome.config for outcome in failed}),
        ("split", 3, {outcome.split for outcome in failed}),
        ("first stage not reached", 4, {failure_name(outcome.failure_stage) for outcome in failed}),
    ):
        options = "".join(f"<option>{escape(value)}</option>" for value in sorted(values))
        choices = f'<option value="">all</option>{options}'
        filters += f'<label>{label} <select data-column="{column}">{choices}</select></label>\n'
    rows = [_failed_row(outcome, folder) for outcome in failed]
    heads = (
        *("episode#", "configuration", "seed#", "split", "first stage not reached", "ended by"),
        *("steps#", "s#", "p_vis#", "disturbed#", "error"),
    )
    linked = any("<a " in row[0] for row in rows)
    command = "<code>robocas eval videos RESULT --policy POLICY</code>"
    videos = "Numbers that are links lead to videos." if linked else f"{command} films some of them."
    note = (
        f'<span id="count">{len(failed)}</span> of {count_of(len(result.outcomes), "episode")}. '
        f"Ended by: the time limit, a failure such as a target on the floor, or an error. {videos}"
    )
    table = html_table(heads, rows, "failed")
    return section("Failed episodes", note, f'<form class="filters">{filters}</form>\n{table}')


def _failed_row(outcome: Outcome, folder: Path | None) -> list[str]:
    video = f"{VIDEOS}/{video_name(outcome.episode)}"
    linked = folder is not None and (folder / video).is_file()
    return [
        f'<a href="{video}">{outcome.episode}</a>' if linked else str(outcome.episode),
        escape(outcome.config),
        str(outcome.seed),
        escape(outcome.split),
        escape(failure_name(outcome.failure_stage)),
        "error" if outcome.error else "failure" if outcome.flags.get("fail") is not None else "time",
        str(outcome.steps),
        f"{outcome.seconds:.1f}",
        "" if outcome.p_vis is None else f"{outcome.p_vis:.2f}",
        f"{outcome.measures.get('disturbed_most', 0):.0f}",
        escape(outcome.error),
    ]
