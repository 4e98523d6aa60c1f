"""The leaderboard of audited entries: ``index.html``, ``results.md`` and ``results.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from scipy.stats import fisher_exact

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import atomic_file, make_folder
from robocas_ms3.core.text import escape_controls
from robocas_ms3.evaluation.audit.replay import Mode
from robocas_ms3.evaluation.leaderboard.entries import get_entry_name, list_stored_episodes
from robocas_ms3.evaluation.leaderboard.markdown import render_leaderboard
from robocas_ms3.evaluation.leaderboard.page import render_leaderboard_page
from robocas_ms3.evaluation.leaderboard.ranks import rank_policies
from robocas_ms3.evaluation.leaderboard.result_rows import make_rows
from robocas_ms3.evaluation.leaderboard.rows import (
    Leaderboard,
    LeaderboardRow,
    get_row_order,
    read_published_rows,
    sort_rows,
    write_leaderboard,
)
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.results.result_files import Result

PAGE, MARKDOWN, ROWS = "index.html", "results.md", "results.json"


class AuditedResult(NamedTuple):
    """Result in an entry whose stored actions were replayed without differences.

    Attributes:
        result: the result.
        protocol: its protocol.
        modes: how each replayed episode was replayed, by its number.
    """

    result: Result
    protocol: LoadedProtocol
    modes: dict[int, Mode]


def write_leaderboard_page(results: Sequence[AuditedResult], out: Path, skipped: Sequence[str] = ()) -> list[Path]:
    """Write the leaderboard of audited results, and return the paths of its files.

    Args:
        results: the results.
        out: output folder; existing files of a leaderboard are replaced.
        skipped: names of the results that are not shown because of a problem.

    Raises:
        EvaluationError: two results have the same policy, protocol, task and split.
        OutputExistsError: ``results.json`` in the folder is no leaderboard.
    """
    rows = sort_rows([*rank_rows(results), *read_published_rows()])
    make_folder(out)
    write_leaderboard(out / ROWS, Leaderboard(rows=rows))
    page = render_leaderboard_page(rows, [one.result for one in results], out, skipped)
    for name, text in ((MARKDOWN, render_leaderboard(rows, skipped)), (PAGE, page)):
        with atomic_file(out / name) as tmp:
            tmp.write_text(escape_controls(text, lines=True), encoding="utf-8")
    return [out / name for name in (PAGE, MARKDOWN, ROWS)]


def rank_rows(results: Sequence[AuditedResult]) -> list[LeaderboardRow]:
    """Return one row per task and split of each result, with its rank among comparable rows (`rank_policies`).

    Rows are comparable if they have the same protocol, task, split, track and calibration, and no differences.
    """
    groups: dict[tuple, list[tuple[LeaderboardRow, dict[int, bool]]]] = {}
    folders: dict[tuple, Path] = {}
    for one in results:
        entry = get_entry_name(one.result.folder)
        for row in make_rows(one.result, one.protocol):
            conditions = row.protocol_hash, row.task, row.split, row.calibration, tuple(row.differences)
            same = (row.weights or entry, *conditions)
            if (first := folders.setdefault(same, one.result.folder)) != one.result.folder:
                what, expected = "two results of the same policy, protocol, task and split", "one result"
                raise EvaluationError(what, where=one.result.folder, expected=expected, found=str(first))
            outcomes = {
                outcome.episode: outcome
                for outcome in one.result.outcomes.values()
                if (outcome.task, outcome.split) == (row.task, row.split)
            }
            successes = {number: outcome.success for number, outcome in outcomes.items()}
            audited = row.model_copy(update={"entry": entry, **_describe_audit(one, successes)})
            groups.setdefault((row.track, *conditions), []).append((audited, successes))
    ranked = []
    for group in groups.values():
        group.sort(key=lambda pair: get_row_order(pair[0]))
        rows = [row for row, _ in group]
        if rows[0].differences:
            ranked += rows
            continue
        ranks = rank_policies([successes for _, successes in group])
        ranked += [
            row.model_copy(update={"rank": rank.rank, "rank_p_value": rank.p_value})
            for row, rank in zip(rows, ranks, strict=True)
        ]
    return ranked


def _describe_audit(audited: AuditedResult, successes: Mapping[int, bool]) -> dict[str, Any]:
    """Return the fields of a row about the audit of its episodes; ``successes``: success by number of the episode."""
    stored = set(list_stored_episodes(audited.result, audited.protocol))
    inside = [success for number, success in successes.items() if number in stored]
    outside = [success for number, success in successes.items() if number not in stored]
    p_value = None
    if inside and outside:
        counts = [[sum(some), len(some) - sum(some)] for some in (inside, outside)]
        found: Any = fisher_exact(counts)  # its type has no attributes
        p_value = float(found.pvalue)
    modes = [mode for number, mode in audited.modes.items() if number in successes]
    tolerances = modes.count("checkpoints")
    return {
        "audited": len(modes) - tolerances,
        "audited_with_tolerances": tolerances,
        "sample_p_value": p_value,
    }
