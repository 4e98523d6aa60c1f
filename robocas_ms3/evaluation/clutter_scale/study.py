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

FITTED_RATES = 0.1, 0.9  # success rates of the policies to which the scale is fitted
MIN_POLICIES = 2


@dataclass(frozen=True)
class PolicyOnScale:
    """Place of a policy on the clutter scale.

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
class ClutterStudy:
    """Clutter scale of the scenes of a protocol, with the places of several policies.

    Attributes:
        scale: the scale.
        difficulty: (S,) difficulty of each scene.
        standard_weights: weight of each feature times its standard deviation over the scenes, by name.
        policies: the policies, the one that handles most clutter first.
        fitted: names of the policies to which the scale was fitted.
    """

    scale: ClutterScale
    difficulty: NDArray[np.floating]
    standard_weights: dict[str, float]
    policies: list[PolicyOnScale]
    fitted: list[str]

    @property
    def mean_auc(self) -> float:
        """Return the mean area under the ROC curve of the fitted policies in unseen scenes."""
        return float(np.nanmean([one.auc for one in self.policies if one.auc is not None]))

    def write(self, path: Path) -> None:
        """Write the study as JSON; infinite limits of intervals are null."""
        write_json(path, _to_json({**asdict(self), "mean_auc": self.mean_auc}))


def make_study(results: Sequence[Result], protocol: LoadedProtocol) -> ClutterStudy:
    """Fit the clutter scale to results on a protocol, and place the policies on it.

    The scale is fitted to the policies that succeed in 10 to 90 % of their episodes.

    Raises:
        EvaluationError: a result has another protocol, or fewer than two policies are between 10 and 90 %.
    """
    for result in results:
        if result.run.protocol_hash != protocol.hash:
            found, wanted = result.run.protocol_hash[:16], protocol.hash[:16]
            raise EvaluationError("result of another protocol", where=result.folder, expected=wanted, found=found)
    features = make_features(read_difficulties_of(protocol))
    successes = np.array([_read_successes(result, len(features)) for result in results])
    rates = np.nanmean(successes, axis=1)
    chosen = np.flatnonzero((rates >= FITTED_RATES[0]) & (rates <= FITTED_RATES[1]))
    if len(chosen) < MIN_POLICIES:
        what, wanted = "too few policies to fit the scale", f"{MIN_POLICIES} policies with 10 to 90 % success"
        raise EvaluationError(what, expected=wanted, found=", ".join(f"{rate:.0%}" for rate in rates))
    scale = fit_clutter_scale(successes[chosen], features)
    difficulty = scale.compute_difficulty(features)
    areas = dict(zip(chosen.tolist(), compute_held_out_auc(successes[chosen], features).tolist(), strict=True))
    policies = [
        PolicyOnScale(_name(result), result.run.policy.track, _fit(difficulty, row), areas.get(number))
        for number, (result, row) in enumerate(zip(results, successes, strict=True))
    ]
    weights = dict(zip(FEATURES, (scale.weights * features.std(axis=0)).tolist(), strict=True))
    fitted = [policies[number].name for number in chosen]
    policies.sort(key=lambda one: _rank(one.curve), reverse=True)
    return ClutterStudy(scale, difficulty, weights, policies, fitted)


def _rank(curve: SuccessCurve) -> tuple[float, float]:
    """Return a sort key; a policy without a curve handles more than all scenes, or less, depending on its rate."""
    rate = curve.successes / curve.episodes
    half = curve.half if curve.half is not None else np.inf if rate > 0.5 else -np.inf
    return half, rate


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
    return value
