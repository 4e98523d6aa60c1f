"""Results of several policies on one protocol, with the difficulty of its scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import write_json
from robocas_ms3.evaluation.clutter_scale.curves import SuccessCurve, fit_success_curve
from robocas_ms3.evaluation.clutter_scale.features import FEATURES, make_features
from robocas_ms3.evaluation.clutter_scale.item_response import ClutterScale, compute_held_out_auc, fit_clutter_scale
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.tables import describe_action_noise, name_policy
from robocas_ms3.evaluation.results import Result
from robocas_ms3.evaluation.scene_difficulties import read_difficulties_of

FITTED_RATES = 0.1, 0.9  # success rates of the policies to which a scale is fitted
MIN_POLICIES = 2
MIN_EPISODES = 20  # of a policy to which a scale is fitted


@dataclass(frozen=True)
class PolicyOnScale:
    """Place of a policy on the clutter scale of a task.

    Attributes:
        name: name of the policy, with action noise.
        track: track of the policy.
        curve: success against difficulty.
        auc: area under the ROC curve in scenes that were not used for the scale; None: not fitted.
    """

    name: str
    track: str
    curve: SuccessCurve
    auc: float | None


@dataclass(frozen=True)
class TaskStudy:
    """Clutter scale of the scenes of a task, with the places of several policies.

    Attributes:
        scale: the scale.
        episodes: (S,) numbers of the episodes whose scenes are on the scale.
        difficulty: (S,) difficulties of these scenes.
        standard_weights: weight of each feature times its standard deviation over the scenes, by name.
        policies: the policies, the one with the highest success rate first.
        fitted: names of the policies to which the scale was fitted.
    """

    scale: ClutterScale
    episodes: NDArray[np.integer]
    difficulty: NDArray[np.floating]
    standard_weights: dict[str, float]
    policies: list[PolicyOnScale]
    fitted: list[str]

    @property
    def mean_auc(self) -> float | None:
        """Return the mean area under the ROC curve of the fitted policies in held-out scenes; None: not known."""
        areas = [policy.auc for policy in self.policies if policy.auc is not None]
        return float(np.mean(areas)) if areas else None


@dataclass(frozen=True)
class ClutterStudy:
    """Clutter scales of the tasks of a protocol.

    Attributes:
        tasks: scale and policies by task.
        left_out: by task without a scale, the success rates of the policies, of which too few are in `FITTED_RATES`.
    """

    tasks: dict[str, TaskStudy]
    left_out: dict[str, list[float]]

    def write(self, path: Path) -> None:
        """Write the study as JSON; infinite limits of intervals are null."""
        content = {name: {**asdict(task), "mean_auc": task.mean_auc} for name, task in self.tasks.items()}
        write_json(path, _to_json({"tasks": content, "left_out": self.left_out}))


def make_study(results: Sequence[Result], protocol: LoadedProtocol) -> ClutterStudy:
    """Fit the clutter scale of each task to results on a protocol, and place the policies on it.

    A scale is fitted to the policies that succeed in 10 to 90 % of their episodes of the task. Scenes without a known
    number of removals are left out.

    Raises:
        EvaluationError: a result has another protocol, or no task has two policies between 10 and 90 %.
    """
    for result in results:
        if result.run.protocol_hash != protocol.hash:
            found, wanted = result.run.protocol_hash[:16], protocol.hash[:16]
            raise EvaluationError("result of another protocol", where=result.folder, expected=wanted, found=found)
    features = make_features(read_difficulties_of(protocol))
    successes = np.array([_read_successes(result, len(features)) for result in results])
    tasks: dict[str, TaskStudy] = {}
    left_out: dict[str, list[float]] = {}
    for task in dict.fromkeys(episode.task for episode in protocol.episodes):
        in_task = np.array([episode.task == task for episode in protocol.episodes])
        episodes = np.flatnonzero(in_task & ~np.isnan(features).any(axis=1))
        counts = (~np.isnan(successes[:, episodes])).sum(axis=1)
        evaluated = np.flatnonzero(counts)
        rates = np.nanmean(successes[evaluated][:, episodes], axis=1)
        fitted = (counts[evaluated] >= MIN_EPISODES) & (rates >= FITTED_RATES[0]) & (rates <= FITTED_RATES[1])
        if fitted.sum() >= MIN_POLICIES:
            chosen = [results[number] for number in evaluated]
            tasks[task] = _make_task_study(chosen, successes[evaluated], fitted, episodes, features)
        else:
            left_out[task] = rates.tolist()
    if not tasks:
        what = "too few policies to fit a scale"
        wanted = f"{MIN_POLICIES} policies with 10 to 90 % success in at least {MIN_EPISODES} episodes of a task"
        found = "; ".join(f"{task}: {', '.join(f'{rate:.0%}' for rate in rates)}" for task, rates in left_out.items())
        raise EvaluationError(what, expected=wanted, found=found)
    return ClutterStudy(tasks, left_out)


def _make_task_study(
    results: Sequence[Result],
    successes: NDArray[np.float64],
    fitted: NDArray[np.bool_],
    episodes: NDArray[np.integer],
    features: NDArray[np.float64],
) -> TaskStudy:
    """Fit the scale of a task to the successes (P, E) of the fitted ones of P policies in the chosen episodes of E."""
    successes, features = successes[:, episodes], features[episodes]
    scale = fit_clutter_scale(successes[fitted], features)
    difficulty = scale.compute_difficulty(features)
    areas = np.full(len(results), np.nan)
    areas[fitted] = compute_held_out_auc(successes[fitted], features)
    policies = [
        PolicyOnScale(
            _name(result), result.run.policy.track, _fit(difficulty, row), None if np.isnan(area) else float(area)
        )
        for result, row, area in zip(results, successes, areas, strict=True)
    ]
    weights = dict(zip(FEATURES, (scale.weights * features.std(axis=0)).tolist(), strict=True))
    names = [policies[number].name for number in np.flatnonzero(fitted)]
    policies.sort(key=lambda policy: policy.curve.successes / policy.curve.episodes, reverse=True)
    return TaskStudy(scale, episodes, difficulty, weights, policies, names)


def _read_successes(result: Result, count: int) -> NDArray[np.float64]:
    row = np.full(count, np.nan)
    for number, outcome in result.outcomes.items():
        row[number] = outcome.success and not outcome.error
    return row


def _name(result: Result) -> str:
    noise = describe_action_noise(result.run)
    return f"{name_policy(result.run)} with {noise}" if noise else name_policy(result.run)


def _fit(difficulty: NDArray[np.floating], row: NDArray[np.float64]) -> SuccessCurve:
    evaluated = ~np.isnan(row)
    return fit_success_curve(difficulty[evaluated], row[evaluated] > 0)


def _to_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_json(entry) for key, entry in value.items()}
    if isinstance(value, list | np.ndarray):
        return [_to_json(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return round(float(value), 6) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value
