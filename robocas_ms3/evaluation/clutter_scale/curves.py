"""Success of one policy against the difficulty of scenes: a logistic curve, and where it crosses 50 %."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from sklearn.linear_model import LogisticRegression

_INVERSE_PENALTY = 1e3  # C of scikit-learn: nearly none
_QUANTILE = float(norm.ppf(0.975))  # of the 95 % interval
Array = NDArray[np.floating]


@dataclass(frozen=True)
class SuccessCurve:
    """Logistic curve of the success of a policy: P(success) = sigmoid(slope * (half - difficulty)).

    Attributes:
        successes, episodes: numbers on which the curve is fitted.
        half: difficulty at which the policy succeeds half of the time; None: success does not fall with the difficulty,
            or all episodes have the same outcome.
        low, high: limits of the 95 % interval of ``half``; infinite if the slope does not differ from 0 significantly.
        slope: steepness of the curve in logits per unit of difficulty; None without ``half``.
    """

    successes: int
    episodes: int
    half: float | None = None
    low: float = -np.inf
    high: float = np.inf
    slope: float | None = None

    def predict(self, difficulty: Array) -> Array:
        """Return the probability (S,) of success at difficulties (S,); the success rate without a curve."""
        if self.half is None or self.slope is None:
            return np.full(len(difficulty), self.successes / self.episodes)
        return 1 / (1 + np.exp(-self.slope * (self.half - difficulty)))


def fit_success_curve(difficulty: Array, success: NDArray[np.bool_]) -> SuccessCurve:
    """Fit the curve of a policy by maximum likelihood.

    The interval is that of Fieller's theorem for the ratio of intercept and slope, which is common for median effective
    doses (Finney, Probit Analysis, 1971, chapter 4).

    Args:
        difficulty: (S,) difficulties of the scenes.
        success: (S,) whether the policy succeeded.
    """
    curve = SuccessCurve(int(success.sum()), len(success))
    if success.all() or not success.any():
        return curve
    model = LogisticRegression(C=_INVERSE_PENALTY, max_iter=1000).fit(difficulty[:, None], success)
    intercept, slope = float(np.asarray(model.intercept_).item()), -float(model.coef_.item())
    if slope <= 0:
        return curve
    inputs = np.stack([np.ones_like(difficulty), -difficulty], axis=1)
    chance = 1 / (1 + np.exp(-(intercept - slope * difficulty)))
    covariance = np.linalg.inv((inputs * (chance * (1 - chance))[:, None]).T @ inputs)
    low, high = compute_ratio_interval(intercept, slope, covariance)
    return SuccessCurve(curve.successes, curve.episodes, intercept / slope, low, high, slope)


def compute_ratio_interval(numerator: float, denominator: float, covariance: Array) -> tuple[float, float]:
    """Return the 95 % interval of the ratio of two normally distributed estimates (Fieller 1954).

    Args:
        numerator: estimate of the numerator.
        denominator: estimate of the denominator.
        covariance: (2, 2) covariance of numerator and denominator.

    Returns:
        Lower and upper limit; infinite if the denominator does not differ from 0 significantly.
    """
    variance = _QUANTILE**2 * covariance
    a, b = denominator**2 - variance[1, 1], numerator * denominator - variance[0, 1]
    if a <= 0:
        return -np.inf, np.inf
    root = float(np.sqrt(b**2 - a * (numerator**2 - variance[0, 0])))
    return (b - root) / a, (b + root) / a
