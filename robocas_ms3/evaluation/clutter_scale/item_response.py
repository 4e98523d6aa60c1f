"""Difficulty of scenes from the successes of several policies: an item response model with scene features.

Model: P(policy p succeeds in scene s) = sigmoid(ability[p] - weights . features[s]). It is a Rasch model whose item
difficulties are explained by features (linear logistic test model, Fischer, Acta Psychologica 37 (1973) 359-374).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import KFold

from robocas_ms3.core.errors import EvaluationError

HARDEST = 10.0  # difficulty of the hardest scene of the fit; the easiest has 0
FOLDS = 5
_INVERSE_PENALTY = 10.0  # C of scikit-learn, for standardized features: keeps weights of correlated features finite
_SMALLEST_SPREAD = 1e-9  # standard deviation below which a feature is constant
Array = NDArray[np.floating]


@dataclass(frozen=True)
class ClutterScale:
    """Linear scale of the difficulty of scenes.

    Attributes:
        weights: (F,) difficulty per unit of each feature.
        offset: difficulty of a scene whose features are 0.
    """

    weights: Array
    offset: float

    def compute_difficulty(self, features: Array) -> Array:
        """Return the difficulty (S,) of scenes with the features (S, F)."""
        return features @ self.weights + self.offset


def fit_clutter_scale(successes: Array, features: Array) -> ClutterScale:
    """Fit the weights of the features to the successes of several policies in the same scenes.

    Args:
        successes: (P, S) 1: policy p succeeded in scene s, 0: it failed, NaN: it was not evaluated there.
        features: (S, F) features of the scenes.

    Returns:
        The scale, on which the easiest of the scenes has 0 and the hardest 10.

    Raises:
        EvaluationError: the scenes have equal features.
    """
    weights = _fit_weights(successes, features)
    raw = features @ weights
    unit = (raw.max() - raw.min()) / HARDEST
    if unit < _SMALLEST_SPREAD:
        raise EvaluationError("the scenes have no scale of difficulty", expected="scenes with different features")
    return ClutterScale(weights / unit, float(-raw.min() / unit))


def compute_auc(difficulty: Array, success: Array) -> float:
    """Return the area under the ROC curve with which the difficulty predicts the failures of a policy.

    Args:
        difficulty: (S,) difficulties of scenes.
        success: (S,) 1: the policy succeeded, 0: it failed, NaN: it was not evaluated.

    Returns:
        The area; NaN if the policy has no successes or no failures.
    """
    evaluated = ~np.isnan(success)
    if not 0 < success[evaluated].sum() < evaluated.sum():
        return float("nan")
    return float(roc_auc_score(1 - success[evaluated], difficulty[evaluated]))


def compute_held_out_auc(successes: Array, features: Array, seed: int = 0) -> Array:
    """Return for each policy the area under the ROC curve with which the difficulty predicts failures in unseen scenes.

    The scenes are split into `FOLDS` parts at random; the scale of each part is fitted to the other parts. The result
    (P,) is the mean over the parts in which the policy has both successes and failures; NaN without such a part.
    """
    areas = np.full((FOLDS, len(successes)), np.nan)
    for fold, (training, held_out) in enumerate(KFold(FOLDS, shuffle=True, random_state=seed).split(features)):
        if len(np.unique(successes[:, training][~np.isnan(successes[:, training])])) < 2:
            continue  # nothing to fit
        difficulty = features[held_out] @ _fit_weights(successes[:, training], features[training])
        for policy, row in enumerate(successes[:, held_out]):
            areas[fold, policy] = compute_auc(difficulty, row)
    counts = (~np.isnan(areas)).sum(axis=0)
    return np.where(counts > 0, np.nansum(areas, axis=0) / np.maximum(counts, 1), np.nan)


def _fit_weights(successes: Array, features: Array) -> Array:
    """Return the difficulty (F,) in logits per unit of each feature."""
    spread = features.std(axis=0)
    spread[spread < _SMALLEST_SPREAD] = 1.0
    policy, scene = np.nonzero(~np.isnan(successes))
    abilities = np.eye(len(successes))[policy]
    inputs = np.concatenate([abilities, -((features - features.mean(axis=0)) / spread)[scene]], axis=1)
    model = LogisticRegression(C=_INVERSE_PENALTY, fit_intercept=False, max_iter=1000)
    model.fit(inputs, successes[policy, scene].astype(int))
    return model.coef_[0, len(successes) :] / spread
