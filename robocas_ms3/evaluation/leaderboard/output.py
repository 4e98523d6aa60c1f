"""The leaderboard of audited entries: ``index.html``, ``results.md`` and ``results.json``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import atomic_file, make_folder
from robocas_ms3.core.text import escape_controls
from robocas_ms3.evaluation.leaderboard.markdown import render_leaderboard
from robocas_ms3.evaluation.leaderboard.page import render_leaderboard_page
from robocas_ms3.evaluation.leaderboard.ranks import rank_policies
from robocas_ms3.evaluation.leaderboard.result_rows import make_rows
from robocas_ms3.evaluation.leaderboard.rows import (
    Leaderboard,
    LeaderboardRow,
    read_published_rows,
    sort_rows,
    write_leaderboard,
)
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.results import Result

PAGE, MARKDOWN, ROWS = "index.html", "results.md", "results.json"


class AuditedResult(NamedTuple):
    """Result in an entry whose stored actions were replayed without differences.

    Attributes:
        result: the result.
        protocol: its protocol.
        audited: number of episodes that were replayed.
    """

    result: Result
    protocol: LoadedProtocol
    audited: int


def write_leaderboard_page(results: Sequence[AuditedResult], out: Path) -> list[Path]:
    """Write the leaderboard of audited results, and return the paths of its files.

    Args:
        results: the results.
        out: output folder; existing files of a leaderboard are replaced.

    Raises:
        EvaluationError: two results have the same policy, protocol, task and split.
        OutputExistsError: ``results.json`` in the folder is no leaderboard.
    """
    rows = sort_rows([*rank_rows(results), *read_published_rows()])
    make_folder(out)
    write_leaderboard(out / ROWS, Leaderboard(rows=rows))
    page = render_leaderboard_page(rows, [one.result for one in results], out)
    for name, text in ((MARKDOWN, render_leaderboard(rows)), (PAGE, page)):
        with atomic_file(out / name) as tmp:
            tmp.write_text(escape_controls(text, lines=True), encoding="utf-8")
    return [out / name for name in (PAGE, MARKDOWN, ROWS)]


def rank_rows(results: Sequence[AuditedResult]) -> list[LeaderboardRow]:
    """Return one row per task and split of each result, with its rank among comparable rows (`rank_policies`).

    Rows are comparable if they have the same protocol, task, split, track, calibration and conditions.
    """
    groups: dict[tuple, list[tuple[LeaderboardRow, dict[int, bool]]]] = {}
    folders: dict[tuple, Path] = {}
    for one in results:
        for row in make_rows(one.result, one.protocol):
            same = row.policy, row.weights, row.protocol_hash, row.task, row.split, row.calibration, *row.differences
            if (first := folders.setdefault(same, one.result.folder)) != one.result.folder:
                what, expected = "two results of the same policy, protocol, task and split", "one result"
                raise EvaluationError(what, where=one.result.folder, expected=expected, found=str(first))
            outcomes = [
                outcome
                for outcome in one.result.outcomes.values()
                if (outcome.task, outcome.split) == (row.task, row.split)
            ]
            key = row.protocol_hash, row.task, row.split, row.track, row.calibration, tuple(row.differences)
            successes = {outcome.episode: outcome.success for outcome in outcomes}
            groups.setdefault(key, []).append((row.model_copy(update={"audited": one.audited}), successes))
    ranked = []
    for group in groups.values():
        group.sort(key=lambda pair: -(pair[0].rate or 0.0))
        ranks = rank_policies([successes for _, successes in group])
        ranked += [
            row.model_copy(update={"rank": rank.rank, "rank_p_value": rank.p_value})
            for (row, _), rank in zip(group, ranks, strict=True)
        ]
    return ranked
