"""A result as one HTML page that needs nothing beside it."""

from __future__ import annotations

import json
from collections import Counter
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from robocas_ms3.core.words import count_of
from robocas_ms3.evaluation.outcomes import Outcome, summarize_retrieval
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.failures import FAILURES, failed_episodes, failure_of, funnel_of
from robocas_ms3.evaluation.report.html import axis, bar, facts, rate, round_up, section, spread, table
from robocas_ms3.evaluation.report.tables import P_VIS_EDGES, WELDED, first_splits
from robocas_ms3.evaluation.report.tables import title as title_of
from robocas_ms3.evaluation.results import Result
from robocas_ms3.evaluation.statistics import Share, share, success_by


def page(result: Result, folder: Path | None = None, protocol: LoadedProtocol | None = None) -> str:
    """The page.

    Args:
        result: to be shown.
        folder: that the page will lie in, with ``videos`` or without.
        protocol: that it was measured by, if it is at hand.
    """
    here = files("robocas_ms3.evaluation.report")
    style, script = ((here / name).read_text(encoding="utf-8") for name in ("style.css", "script.js"))
    title = escape(title_of(result))
    parts = [_lead(result, protocol)]
    if result.outcomes:
        parts += [
            _headline(result),
            _splits(result),
            _funnels(result),
            _failures(result),
            _hidden(result),
            _retrieval(result),
        ]
        parts += [_seconds(result), _care(result)]
    parts += [_measured_with(result, protocol), failed_episodes(result, folder)]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
        f"{''.join(parts)}</main>\n<script>\n{script}</script>\n</body>\n</html>\n"
    )


def _lead(result: Result, protocol: LoadedProtocol | None) -> str:
    count = len(result.outcomes)
    whole = (
        count_of(count, "episode") if protocol is None else f"{count} of {count_of(len(protocol.episodes), 'episode')}"
    )
    said = f"{whole}, protocol hash <code>{escape(result.run.protocol_hash[:16])}</code>."
    notes = [WELDED] if result.run.weld else []
    if protocol is not None and count < len(protocol.episodes):
        missing = Counter(episode.config for episode in protocol.episodes if episode.episode not in result.outcomes)
        of = ", ".join(f"{many} of {escape(config)}" for config, many in missing.items())
        notes.append(
            f"Missing of the protocol: {count_of(missing.total(), 'episode')} ({of}). This is no whole result."
        )
    broken = result.broken_off()
    if broken:
        notes.append(f"Broken off by an error: {count_of(broken, 'episode')}, counted as failed.")
    return f'<p class="lead">{said}</p>\n' + "".join(f'<p class="note">{note}</p>\n' for note in notes)


def _headline(result: Result) -> str:
    rows = []
    groups = result.by("config")
    for config, outcomes in groups.items() if result.repeats() else _with_all(groups):
        found = result.rate("success", outcomes)
        seconds = float(np.mean([outcome.seconds for outcome in outcomes]))
        steps = float(np.mean([outcome.steps for outcome in outcomes]))
        has_v0 = any("success_v0" in outcome.flags for outcome in outcomes)  # not where there is no basket
        v0 = result.rate("success_v0", outcomes) if has_v0 else None
        others = [rate(result.rate("success_at_end", outcomes)), rate(v0)]
        task = ", ".join(sorted({outcome.task for outcome in outcomes})) if config in groups else ""
        rows.append(
            [escape(config), escape(task), str(found.n), rate(found), bar(found, "good"), *others]
            + [f"{steps:.0f}", f"{seconds:.1f}"]
        )
    heads = ("configuration", "task", "n#", "success#", "0 to 100 %", "at the end#", "upstream's#", "steps#", "s#")
    said = (
        "Success held at some moment; at the last one; upstream's rule at the last one. Intervals are "
        "Clopper and Pearson's, 95 %. Steps and seconds of the scene are means over all episodes"
        + (
            "."
            if result.repeats()
            else "; so is the last row, in which a configuration with more episodes weighs more."
        )
    )
    return section("Success", said, table(heads, rows, "bars"))


def _splits(result: Result) -> str:
    splits = result.by("split")
    if len(splits) < 2:
        return ""
    rows = []
    for task, outcomes in _with_all(result.by("task")):
        row = [escape(task)]
        for split in splits:
            of_split = [outcome for outcome in outcomes if outcome.split == split]
            found = result.rate("success", of_split) if of_split else None
            row += [str(len(of_split)), rate(found), bar(found, "good")]
        rows.append(row)
    heads = [
        "task",
        *(head for split in splits for head in (f"{escape(split)}, n#", "success#", "0 to 100 %")),
    ]
    return section("Splits", "Success, side by side.", table(heads, rows, "splits"))


def _funnels(result: Result) -> str:
    cards = []
    for config, outcomes in result.by("config").items():
        rows = []
        for stage, said in funnel_of(outcomes[0].task).items():
            if any(stage in outcome.flags for outcome in outcomes):
                rows.append(_row(said, result.rate(stage, outcomes), "good" if stage == "success" else ""))
        cards.append(f"<figure><figcaption>{escape(config)}, n {len(outcomes)}</figcaption>{''.join(rows)}</figure>\n")
    said = "In how many episodes each stage was come to, with its interval. A stage may be left out on the way."
    return section("Stages", said, f'<div class="cards">\n{"".join(cards)}</div>\n')


def _failures(result: Result) -> str:
    counts = {
        config: Counter(outcome.failure_stage for outcome in outcomes if outcome.failure_stage)
        for config, outcomes in result.by("config").items()
    }
    stages = [stage for stage in FAILURES if any(stage in count for count in counts.values())]
    stages += sorted({stage for count in counts.values() for stage in count} - set(stages))
    if not stages:
        return section("Where episodes failed", "None did.", "")
    rows = []
    for config, count in counts.items():
        n = len(result.by("config")[config])
        cells = [
            f'<span class="heat" style="--share: {100 * count[stage] / n:.0f}%">{count[stage] or ""}</span>'
            for stage in stages
        ]
        rows.append([escape(config), str(n), str(count.total()), *cells])
    heads = ("configuration", "n#", "failed#", *(f"{escape(failure_of(stage))}#" for stage in stages))
    said = "Episodes by the stage that they did not come to, next after the furthest one that they did."
    return section("Where episodes failed", said, table(heads, rows, "heats"))


def _hidden(result: Result) -> str:
    hidden = [outcome for outcome in first_splits(result) if outcome.p_vis is not None]
    if not hidden:
        return ""
    bins = success_by([o.p_vis or 0.0 for o in hidden], [o.success for o in hidden], P_VIS_EDGES)
    rows = [
        [f"{b.low:g} to {b.high:g}", str(b.share.n if b.share else 0), rate(b.share), bar(b.share, "good")]
        for b in bins
    ]
    configs = ", ".join(sorted({outcome.config for outcome in hidden}))
    said = f"By p_vis, the share of the target that is seen from above at the beginning; episodes of {escape(configs)}."
    return section("Success by occlusion", said, table(("p_vis", "n#", "success#", "0 to 100 %"), rows, "bars"))


def _retrieval(result: Result) -> str:
    rows = []
    for config, outcomes in result.by("config").items():
        found = summarize_retrieval(outcome.retrieval for outcome in outcomes)
        if found is not None:
            needed = f"{100 * found.needed:.0f} %"
            rows.append(
                [
                    escape(config),
                    str(found.held),
                    f"{found.score:.2f}",
                    f"{found.moved:.1f}",
                    needed,
                    f"{found.left:.1f}",
                ]
            )
    if not rows:
        return ""
    heads = ("configuration", "target held#", "order score#", "moved, mean#", "needed of these#", "left, mean#")
    said = (
        "Objects that were moved before the target was first held. Needed: they hid or hemmed it in, or lay over one "
        "that did. The score is the share, of what was moved or left in the way, that was needed and moved from the "
        "top down."
    )
    return section("Retrieval order", said, table(heads, rows))


def _seconds(result: Result) -> str:
    taken = {
        config: [s for o in outcomes if (s := o.flag_seconds.get("success")) is not None]
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
    said = "Seconds of the scene, over the episodes that succeeded. A tick is an episode, the box half of them."
    return section("Seconds to success", said, table(heads, rows, "bars"))


def _care(result: Result) -> str:
    rows = []
    for config, outcomes in result.by("config").items():
        measures = {
            name: np.array([outcome.measures.get(name, np.nan) for outcome in outcomes])
            for name in ("disturbed_most", "fallen", "path_length", "contact_impulse")
        }
        fallen = [outcome for outcome in outcomes if outcome.measures.get("fallen", 0) > 0]
        disturbed = [outcome for outcome in outcomes if outcome.measures.get("disturbed_most", 0) > 0]
        rows.append(
            [
                escape(config),
                rate(share(len(disturbed), len(outcomes))),
                f"{measures['disturbed_most'].mean():.2f}",
                rate(share(len(fallen), len(outcomes))),
                f"{measures['fallen'].mean():.2f}",
                f"{measures['path_length'].mean():.2f}",
                f"{np.median(measures['contact_impulse']):.1f}",
                f"{np.mean([outcome.inference_ms for outcome in outcomes]):.1f}",
            ]
        )
    heads = (
        *("configuration", "any disturbed#", "disturbed, mean#", "any fallen#", "fallen, mean#"),
        *("path, mean m#", "impulse, median N s#", "policy, mean ms a step#"),
    )
    said = (
        "Disturbed: objects other than the target more than 3 cm from where they stood, or tipped, at the worst "
        "moment. Path is the gripper's. Impulse is of contacts between gripper and objects. The policy's time is by "
        "the clock."
    )
    return section("Disturbance and effort", said, table(heads, rows))


def _row(said: str, found: Share, kind: str) -> str:
    return f'<div class="row"><span>{escape(said)}</span>{bar(found, kind)}<b>{100 * found.rate:.0f} %</b></div>\n'


def _with_all(groups: dict[str, list[Outcome]]) -> list[tuple[str, list[Outcome]]]:
    """The groups, and where there are several, all of them together."""
    every = [outcome for outcomes in groups.values() for outcome in outcomes]
    return [*groups.items(), *([("all together", every)] if len(groups) > 1 else [])]


def _measured_with(result: Result, protocol: LoadedProtocol | None) -> str:
    """A section of the page."""
    run, policy = result.run, result.run.policy
    pairs: list[tuple[str, object]] = [("protocol", run.protocol), ("its hash", run.protocol_hash)]
    if protocol is not None:
        pairs += [("what it says", protocol.rules.description), ("its rules", _rules(protocol))]
    pairs += [("policy", policy.name)]
    pairs += [
        (f"policy, {name}", _plain(value))
        for name, value in policy.model_dump(exclude_unset=True).items()
        if name != "name"
    ]
    pairs += [
        ("upstream's weld", "yes" if run.weld else "no"),
        ("backend", run.backend),
        ("versions", _plain(run.versions)),
    ]
    pairs += [(f"pack {name}", value) for name, value in run.pack_hashes.items()]
    machines = {_plain(part.machine) for part in run.parts} or {_plain(run.machine or {})}
    pairs += [("machine", machine) for machine in sorted(machines)]
    rows = [[escape(part.folder), str(part.episodes)] for part in run.parts]
    parts = table(("part", "episodes#"), rows) if rows else ""
    return section("What it was measured with", "", facts(pairs) + parts)


def _rules(protocol: LoadedProtocol) -> str:
    kept = {"rate_hz", "stepping", "max_steps", "max_seconds", "ends_on", "max_v0_steps"}
    rules = protocol.rules.model_dump(mode="json", include=kept)
    return _plain({name: value for name, value in rules.items() if value is not None})


def _plain(value: object) -> str:
    """A dictionary as ``a 1, b 2``; anything else as JSON, strings as they are."""
    if isinstance(value, dict):
        return ", ".join(
            f"{name} {_plain(inner) if not isinstance(inner, dict) else json.dumps(inner)}"
            for name, inner in value.items()
        )
    return value if isinstance(value, str) else json.dumps(value)
