"""Measure how well the clutter scale predicts the failures of policies; print JSON.

python benchmarks/clutter_scale.py leaderboard/*/clutter-scale-v1 docs/results/clutter_scale/*

JSON, for each task:
  auc             area under the ROC curve in scenes that were not used for the fit, by policy, with all features
  mean_auc        mean of "auc"; also with each feature alone, and without each feature
  auc_of_others   the same for another predictor: the share of the other policies that fail in the scene (not fitted)
  width_ratios    width of the 95 % interval of the difficulty at 50 % success from bootstrap samples of the scenes,
                  with the scale fitted again, divided by that of Fieller's theorem; only policies with a finite
                  interval and a difficulty on the scale
  adaptive        simulation of an evaluation that chooses scenes near the present estimate: median width of the
                  interval with all scenes, and with three quarters and half of them, chosen adaptively or at random;
                  coverage: share of the adaptive intervals with half of the scenes that contain the true difficulty
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass

import numpy as np
import tyro
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning

from robocas_ms3.cli.eval_results import read_evaluations
from robocas_ms3.cli.options import Folders
from robocas_ms3.evaluation.clutter_scale.curves import SuccessCurve, fit_success_curve
from robocas_ms3.evaluation.clutter_scale.features import FEATURES
from robocas_ms3.evaluation.clutter_scale.item_response import (
    HARDEST,
    compute_auc,
    compute_held_out_auc,
    fit_clutter_scale,
)
from robocas_ms3.evaluation.clutter_scale.task_results import TaskResults, describe_policy, split_by_task
from robocas_ms3.evaluation.results.result_files import load_protocol_of

FIRST, STEP = 20, 4  # scenes with which an adaptive evaluation begins, and that it adds before it fits again
LIMITS = -20.0, 30.0  # of an interval: infinite ones are cut
Array = NDArray[np.floating]


@dataclass
class Benchmark:
    folders: Folders
    """Results on one protocol."""
    bootstrap: int = 400
    """Number of bootstrap samples; 0: leave them out."""
    repetitions: int = 60
    """Number of simulated adaptive evaluations of each policy; 0: leave them out."""
    seed: int = 0
    """Seed of the samples and simulations."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    warnings.simplefilter("ignore", ConvergenceWarning)
    results = read_evaluations(cfg.folders)
    tasks = split_by_task(results, load_protocol_of(results[0], None))
    print(json.dumps({name: measure_task(task, cfg) for name, task in tasks.items()}, indent=2))


def measure_task(task: TaskResults, cfg: Benchmark) -> dict[str, object]:
    """Return the measurements of a task by name."""
    chosen = task.find_fitted()
    names = [describe_policy(task.results[number]) for number in np.flatnonzero(chosen)]
    successes, features = task.successes[chosen], task.features
    difficulty = fit_clutter_scale(successes, features).compute_difficulty(features)
    curves = [fit_success_curve(difficulty[~np.isnan(row)], row[~np.isnan(row)] > 0) for row in successes]
    areas, others = compute_held_out_auc(successes, features), compare_with_others(task, chosen)
    mean_auc = {"all": np.nanmean(areas)}
    for column, feature in enumerate(FEATURES):
        mean_auc[f"{feature} alone"] = np.nanmean(compute_held_out_auc(successes, features[:, [column]]))
        mean_auc[f"without {feature}"] = np.nanmean(
            compute_held_out_auc(successes, np.delete(features, column, axis=1))
        )
    content: dict[str, object] = {
        "policies": len(names),
        "scenes": len(features),
        "auc": round_all(dict(zip(names, areas, strict=True))),
        "mean_auc": round_all(mean_auc),
        "auc_of_others": round_all({**dict(zip(names, others, strict=True)), "mean": np.nanmean(others)}),
    }
    random = np.random.default_rng(cfg.seed)
    if cfg.bootstrap:
        ratios = compute_width_ratios(successes, features, curves, cfg.bootstrap, random)
        content["width_ratios"] = round_all(dict(zip(names, ratios, strict=True)))
    if cfg.repetitions:
        content["adaptive"] = {
            name: simulate_adaptive(curve, difficulty, cfg.repetitions, random)
            for name, curve in zip(names, curves, strict=True)
            if np.isfinite(get_width(curve))
        }
    return content


def compare_with_others(task: TaskResults, chosen: NDArray[np.bool_]) -> Array:
    """Return for each chosen policy how well the share of failing other policies predicts its failures."""
    areas = []
    for number in np.flatnonzero(chosen):
        others = np.delete(task.successes, number, axis=0)
        areas.append(compute_auc(1 - np.nanmean(others, axis=0), task.successes[number]))
    return np.array(areas)


def compute_width_ratios(
    successes: Array, features: Array, curves: list[SuccessCurve], samples: int, random: np.random.Generator
) -> Array:
    """Return (P,) width of the bootstrap interval, divided by that of Fieller's theorem; NaN without a finite one."""
    halves = np.full((samples, len(curves)), np.nan)
    for sample in range(samples):
        scenes = random.integers(len(features), size=len(features))
        scale = fit_clutter_scale(successes[:, scenes], features[scenes])
        # the scale of all scenes, so that the ends of the scales are equal
        everywhere = features @ scale.weights
        unit = (everywhere.max() - everywhere.min()) / HARDEST
        difficulty = (everywhere - everywhere.min()) / unit
        for policy, row in enumerate(successes[:, scenes]):
            used = ~np.isnan(row)
            curve = fit_success_curve(difficulty[scenes][used], row[used] > 0)
            halves[sample, policy] = np.nan if curve.half is None else np.clip(curve.half, *LIMITS)
    low, high = np.nanquantile(halves, [0.025, 0.975], axis=0)
    widths = np.array([get_width(curve) for curve in curves])
    on_scale = np.array([curve.half is not None and 0 <= curve.half <= HARDEST for curve in curves])
    return np.where(on_scale & np.isfinite(widths), (high - low) / widths, np.nan)


def simulate_adaptive(
    curve: SuccessCurve, difficulty: Array, repetitions: int, random: np.random.Generator
) -> dict[str, float | None]:
    """Return the median widths of the intervals of simulated evaluations of a policy with a known curve."""
    count = len(difficulty)
    widths: dict[str, list[float]] = {}
    contained = []
    for _ in range(repetitions):
        success = random.random(count) < curve.predict(difficulty)
        order = choose_adaptively(difficulty, success, count * 3 // 4)
        half = fit(difficulty, success, order[: count // 2])
        shuffled = random.permutation(count)[: count // 2]
        for name, estimate in {
            "all": fit(difficulty, success, np.arange(count)),
            "adaptive, 3/4": fit(difficulty, success, order),
            "adaptive, half": half,
            "random, half": fit(difficulty, success, shuffled),
        }.items():
            widths.setdefault(name, []).append(get_width(estimate, cut=True))
        contained.append(curve.half is not None and half.low <= curve.half <= half.high)
    return round_all({**{name: np.median(values) for name, values in widths.items()}, "coverage": np.mean(contained)})


def choose_adaptively(difficulty: Array, success: NDArray[np.bool_], count: int) -> NDArray[np.integer]:
    """Return ``count`` scenes in the order in which an adaptive evaluation chooses them.

    It begins with scenes at equal distances in the order of their difficulty. Then it adds those that reduce the
    variance of the estimate most (c-optimal design; the estimate is the ratio of intercept and slope, delta method).
    """
    spread = np.argsort(difficulty, kind="stable")[np.linspace(0, len(difficulty) - 1, FIRST).round().astype(int)]
    order = list(dict.fromkeys(spread.tolist()))
    inputs = np.stack([np.ones_like(difficulty), -difficulty], axis=1)
    while len(order) < count:
        curve = fit(difficulty, success, np.array(order))
        half = float(np.mean(difficulty)) if curve.half is None else float(np.clip(curve.half, 0, HARDEST))
        slope = 0.5 if curve.slope is None else curve.slope
        chance = 1 / (1 + np.exp(-slope * (half - difficulty)))
        scaled = inputs * np.sqrt(chance * (1 - chance))[:, None]
        gradient = np.array([1.0, -half])
        for _ in range(min(STEP, count - len(order))):
            covariance = np.linalg.inv(scaled[order].T @ scaled[order] + 1e-9 * np.eye(2))
            projected = scaled @ covariance
            gain = (projected @ gradient) ** 2 / (1 + (projected * scaled).sum(axis=1))  # Sherman and Morrison
            gain[order] = -1
            order.append(int(gain.argmax()))
    return np.array(order)


def fit(difficulty: Array, success: NDArray[np.bool_], scenes: NDArray[np.integer]) -> SuccessCurve:
    """Return the curve of some of the scenes."""
    return fit_success_curve(difficulty[scenes], success[scenes])


def get_width(curve: SuccessCurve, *, cut: bool = False) -> float:
    """Return the width of the interval of the difficulty at 50 % success; ``cut``: its limits are those of `LIMITS`."""
    if cut:
        return float(np.clip(curve.high, *LIMITS) - np.clip(curve.low, *LIMITS))
    return curve.high - curve.low


def round_all(values: dict[str, float]) -> dict[str, float | None]:
    """Return rounded values; null for values that are not known."""
    return {name: round(float(value), 2) if np.isfinite(value) else None for name, value in values.items()}


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
