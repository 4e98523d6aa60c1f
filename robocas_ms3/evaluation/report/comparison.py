"""Paired comparisons over the same scenes: results of one protocol, or the splits of one result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.text import escape_markdown, format_count
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.tables import describe_action_noise, name_measurement, name_policy
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.statistics import Comparison, adjust_p_values, compare_successes, make_power_warning

_ALPHA = 0.05
ALL = "all"


@dataclass(frozen=True)
class ComparisonRow:
    """Row of the table: the comparison of two results, or of two splits, in the scenes of a configuration or task.

    Attributes:
        where: name of the configuration or task, or `ALL`.
        pair: names of the first and of the second result or split.
        tracks: tracks of their policies.
        found: comparison with the second as run A and the first as run B.
    """

    where: str
    pair: tuple[str, str]
    tracks: tuple[str, str]
    found: Comparison


def compare_results(results: Sequence[Result]) -> str:
    """Compare two or more results over their common episodes; return a Markdown table.

    Raises:
        EvaluationError: the results have different protocols or different action noise, only some have the weld, or no
            episode is in all results.
    """
    first = results[0]
    for other in results[1:]:
        if first.run.protocol_hash != other.run.protocol_hash:
            expected, found = first.run.protocol_hash[:16], other.run.protocol_hash[:16]
            what = "cannot compare results of different protocols"
            expected, found = f"protocol hash {expected}", f"protocol hash {found}"
            raise EvaluationError(what, where=other.folder, expected=expected, found=found)
        if first.run.weld != other.run.weld:
            welded = (first if first.run.weld else other).folder
            raise EvaluationError(
                "cannot compare results with and without RoboCAS-v0's weld",
                where=welded,
                fix="Evaluate all policies with the same weld setting.",
            )
        if first.run.action_noise != other.run.action_noise:
            expected, found = (describe_action_noise(run.run) or "no action noise" for run in (first, other))
            what, fix = "cannot compare results with different action noise", "Use the same --action-noise."
            raise EvaluationError(what, where=other.folder, expected=expected, found=found, fix=fix)
    shared = sorted(set.intersection(*(set(result.outcomes) for result in results)))
    if not shared:
        what, fix = "the results have no common episodes", "Compare results of the same episodes, or of all episodes."
        raise EvaluationError(what, where=results[-1].folder, fix=fix)
    names = [chr(ord("A") + number) for number in range(len(results))]
    measured = name_measurement(first.run)
    runs = [f"{name}: {_name_policy(one, results)} ({one.folder})" for name, one in zip(names, results, strict=True)]
    both = "both" if len(results) == 2 else "all"
    head = escape_markdown(
        f"{', '.join(runs)}; {format_count(len(shared), 'episode')} of {measured} in {both} results."
    )
    others = [one.run for one in results[1:]]
    differing = ["backend"] if any(run.backend != first.run.backend for run in others) else []
    differing += ["versions"] if any(run.versions != first.run.versions for run in others) else []
    if differing:
        head += f" **Measured with different {' and '.join(differing)}.**"
    if any(run.policy.track != first.run.policy.track for run in others):
        head += " **The policies have different tracks. Compare policies within a track.**"
    configs = sorted({first.outcomes[number].config for number in shared})
    rows = []
    pooled = len({(first.outcomes[number].task, first.outcomes[number].seed) for number in shared}) == len(shared)
    for config in [*configs, *([ALL] if len(configs) > 1 and pooled else [])]:
        numbers = [number for number in shared if config in (ALL, first.outcomes[number].config)]
        successes = [[result.outcomes[number].success for number in numbers] for result in results]
        for one, other in combinations(range(len(results)), 2):
            found = compare_successes(successes[other], successes[one])
            tracks = results[one].run.policy.track, results[other].run.policy.track
            rows.append(ComparisonRow(config, (names[one], names[other]), tracks, found))
    return _render_table(head, "configuration", rows)


def _name_policy(result: Result, results: Sequence[Result]) -> str:
    """Return the policy of a result; also its tasks, if the results have other tasks in the same episodes."""
    name, played_as = name_policy(result.run), result.run.played_as
    if all(one.run.played_as == played_as for one in results):
        return name
    tasks = dict.fromkeys(one.task for one in result.outcomes.values())
    texts = (f"{task} in the episodes of {played_as[task]}" if task in played_as else task for task in tasks)
    return f"{name}, {' and '.join(texts)}"


def compare_splits(result: Result, protocol: LoadedProtocol) -> str:
    """Compare each split with the first split that has the same scenes, per task; return a Markdown table.

    Raises:
        EvaluationError: the result has another protocol hash, or no two splits have the same scenes.
    """
    if (found := result.run.protocol_hash) != protocol.hash:
        raise EvaluationError(
            "the result was measured with other files of the protocol",
            where=result.folder,
            expected=f"protocol hash {protocol.hash}",
            found=found,
        )
    scenes: dict[tuple[str, bytes], list[tuple[str, str]]] = {}  # (split, configuration) with equal scenes
    for task, split, config in dict.fromkeys((one.task, one.split, one.config) for one in protocol.episodes):
        scenes.setdefault((task, protocol.layouts_file(config).read_bytes()), []).append((split, config))
    rows, track = [], result.run.policy.track
    for (task, _), (first, *others) in scenes.items():
        for other in others:
            successes_by_seed = [
                {
                    one.seed: one.success
                    for one in result.outcomes.values()
                    if (one.split, one.config) == split_and_config
                }
                for split_and_config in (first, other)
            ]
            seeds = sorted(successes_by_seed[0].keys() & successes_by_seed[1].keys())
            if seeds:
                found = compare_successes(
                    [successes_by_seed[1][seed] for seed in seeds], [successes_by_seed[0][seed] for seed in seeds]
                )
                rows.append(ComparisonRow(task, (first[0], other[0]), (track, track), found))
    if not rows:
        fix = "Pass a second result folder to compare with."
        raise EvaluationError("no two splits of the result have the same scenes", where=result.folder, fix=fix)
    head = f"{name_policy(result.run)} ({result.folder}), splits of {result.run.protocol} over the same scenes."
    return _render_table(escape_markdown(head), "task", rows)


def _render_table(head: str, where: str, rows: list[ComparisonRow]) -> str:
    """Return the Markdown table with p-values that Holm's method adjusts: rows `ALL` are one family, others another."""
    adjusted: dict[int, tuple[float, int]] = {}
    for pooled in (False, True):
        family = [number for number, row in enumerate(rows) if (row.where == ALL) == pooled]
        for number, p in zip(family, adjust_p_values([rows[number].found.p_value for number in family]), strict=True):
            adjusted[number] = p, len(family)
    lines = [
        f"{head} Second - first: percentage points. McNemar's exact test, Tango's 95 % interval. Decide by Holm's p, "
        f"adjusted for all rows except `{ALL}`, and separately for the rows `{ALL}`.",
        "",
        f"| {where} | first, second | tracks | n | first | second | only first | only second | second - first | p "
        "| Holm's p |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    warnings = []
    for number, row in enumerate(rows):
        c, (p, claims) = row.found, adjusted[number]
        change = f"{100 * c.difference:+.1f} ({100 * c.low:+.1f} to {100 * c.high:+.1f})"
        counts = (c.n, c.successes_b, c.successes_a, c.only_b, c.only_a, change, f"{c.p_value:.3g}", f"{p:.3g}")
        tracks = ", ".join(dict.fromkeys(row.tracks))
        names = tuple(escape_markdown(text) for text in (row.where, ", ".join(row.pair), tracks))
        lines.append(f"| {' | '.join(map(str, (*names, *counts)))} |")
        warning = None if p <= _ALPHA else make_power_warning(c, alpha=_ALPHA / claims)
        if warning:
            pair = "" if len({row.pair for row in rows}) == 1 else f", {', '.join(row.pair)}"
            warnings.append(f"- {escape_markdown(f'{row.where}{pair}')}: {warning}")
    return "\n".join([*lines, *(["", *warnings] if warnings else [])]) + "\n"
