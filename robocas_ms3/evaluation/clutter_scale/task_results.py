"""Successes of several policies in the scenes of each task of a protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.clutter_scale.features import make_features
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.protocols.scene_difficulties import read_difficulties_of
from robocas_ms3.evaluation.report.tables import describe_action_noise, name_policy
from robocas_ms3.evaluation.results.result_files import Result

FITTED_RATES = 0.1, 0.9  # success rates of the policies to which a scale is fitted
MIN_EPISODES = 20  # of a policy to which a scale is fitted


@dataclass(frozen=True)
class TaskResults:
    """Results of the policies that were evaluated in a task.

    Attributes:
        results: P results.
        successes: (P, S) 1: success, 0: failure, NaN: not evaluated.
        episodes: (S,) numbers of the episodes.
        features: (S, F) features of the scenes.
    """

    results: list[Result]
    successes: NDArray[np.float64]
    episodes: NDArray[np.integer]
    features: NDArray[np.float64]

    def find_fitted(self) -> NDArray[np.bool_]:
        """Return (P,) whether a scale can be fitted to each policy."""
        counts, rates = (~np.isnan(self.successes)).sum(axis=1), np.nanmean(self.successes, axis=1)
        return (counts >= MIN_EPISODES) & (rates >= FITTED_RATES[0]) & (rates <= FITTED_RATES[1])

    def count_successes(self) -> dict[str, tuple[int, int]]:
        """Return the numbers of successes and episodes of each policy by its name."""
        counts = [(int(np.nansum(row)), int((~np.isnan(row)).sum())) for row in self.successes]
        return {describe_policy(result): count for result, count in zip(self.results, counts, strict=True)}


def split_by_task(results: Sequence[Result], protocol: LoadedProtocol) -> dict[str, TaskResults]:
    """Return the results in each task, without policies and tasks that were not evaluated."""
    features = make_features(read_difficulties_of(protocol))
    successes = np.array([_read_successes(result, len(features)) for result in results])
    tasks: dict[str, TaskResults] = {}
    for task in dict.fromkeys(episode.task for episode in protocol.episodes):
        in_task = np.array([episode.task == task for episode in protocol.episodes])
        episodes = np.flatnonzero(in_task & ~np.isnan(features).any(axis=1))
        evaluated = np.flatnonzero((~np.isnan(successes[:, episodes])).any(axis=1))
        if len(evaluated):
            chosen = [results[number] for number in evaluated]
            tasks[task] = TaskResults(chosen, successes[np.ix_(evaluated, episodes)], episodes, features[episodes])
    return tasks


def _read_successes(result: Result, count: int) -> NDArray[np.float64]:
    row = np.full(count, np.nan)
    for number, outcome in result.outcomes.items():
        if number >= count:
            what, expected = "an episode is not in the protocol", f"fewer than {count} episodes"
            raise EvaluationError(what, where=result.folder, expected=expected, found=f"episode {number}")
        row[number] = outcome.success and not outcome.error
    return row


def describe_policy(result: Result) -> str:
    """Return the name of the policy of a result, with its action noise."""
    noise = describe_action_noise(result.run)
    return f"{name_policy(result.run)} with {noise}" if noise else name_policy(result.run)
