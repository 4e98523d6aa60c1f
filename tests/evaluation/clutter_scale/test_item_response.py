"""Fits of the clutter scale to successes that follow a known model."""

from __future__ import annotations

import numpy as np
import pytest

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.clutter_scale.curves import compute_ratio_interval, fit_success_curve
from robocas_ms3.evaluation.clutter_scale.item_response import compute_held_out_auc, fit_clutter_scale

WEIGHTS = np.array([1.5, 3.0, 0.0])


@pytest.fixture(scope="module")
def study():
    """Return successes (6, 400) and features (400, 3) of the model; the third feature has no effect."""
    rng = np.random.default_rng(0)
    features = np.stack([rng.integers(0, 4, 400), rng.uniform(0, 1, 400), rng.normal(size=400)], axis=1)
    abilities = np.linspace(1, 5, 6)
    chance = 1 / (1 + np.exp(-(abilities[:, None] - features @ WEIGHTS)))
    return (rng.uniform(size=chance.shape) < chance).astype(float), features


def test_fitted_weights_are_those_of_the_model(study):
    scale = fit_clutter_scale(*study)
    difficulty = scale.compute_difficulty(study[1])
    assert difficulty.min() == pytest.approx(0, abs=1e-9)
    assert difficulty.max() == pytest.approx(10)
    assert scale.weights[1] / scale.weights[0] == pytest.approx(2, rel=0.15)
    assert abs(scale.weights[2]) < 0.1 * scale.weights[0]
    assert np.corrcoef(difficulty, study[1] @ WEIGHTS)[0, 1] > 0.99


def test_missing_evaluations_are_left_out(study):
    successes, features = study
    partial = successes.copy()
    partial[0, ::2] = np.nan
    partial[5, 300:] = np.nan
    difficulty = fit_clutter_scale(partial, features).compute_difficulty(features)
    assert np.corrcoef(difficulty, features @ WEIGHTS)[0, 1] > 0.99


def test_held_out_auc(study):
    successes, features = study
    assert (compute_held_out_auc(successes, features) > 0.75).all()
    noise = np.random.default_rng(1).normal(size=features.shape)
    assert np.abs(compute_held_out_auc(successes, noise) - 0.5).max() < 0.1
    always = np.concatenate([successes, np.ones((1, 400))])
    assert np.isnan(compute_held_out_auc(always, features)[-1]), "no failures to predict"


def test_parts_without_both_outcomes_are_left_out():
    """The only success is in one part, so the fit without this part has nothing to learn from."""
    successes = np.zeros((2, 10))
    successes[:, 3] = 1
    areas = compute_held_out_auc(successes, np.arange(20.0).reshape(10, 2))
    assert np.isnan(areas).all()


def test_feature_that_is_constant_up_to_rounding_has_no_weight(study):
    successes, features = study
    constant = 0.9 + 1e-16 * np.arange(400)
    scale = fit_clutter_scale(successes, np.column_stack([features, constant]))
    assert abs(scale.weights[3]) < 1


def test_equal_scenes_have_no_scale():
    with pytest.raises(EvaluationError):
        fit_clutter_scale(np.array([[0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]), np.ones((3, 2)))


def test_curve_crosses_half_at_the_ability():
    rng = np.random.default_rng(2)
    difficulty = rng.uniform(0, 10, 300)
    success = rng.uniform(size=300) < 1 / (1 + np.exp(-1.2 * (4 - difficulty)))
    curve = fit_success_curve(difficulty, success)
    assert curve.half is not None
    assert curve.slope == pytest.approx(1.2, abs=0.3)
    assert curve.low < 4 < curve.high
    assert curve.high - curve.low < 1
    assert curve.predict(np.array([curve.half]))[0] == pytest.approx(0.5)
    assert (np.diff(curve.predict(np.linspace(0, 10, 5))) < 0).all()


@pytest.mark.parametrize("outcome", [True, False])
def test_equal_outcomes_have_no_curve(outcome):
    curve = fit_success_curve(np.arange(10.0), np.full(10, outcome))
    assert curve.half is None
    assert (curve.successes, curve.episodes) == (10 * outcome, 10)
    assert curve.predict(np.zeros(2)).tolist() == [float(outcome)] * 2


def test_success_that_grows_with_the_difficulty_has_no_curve():
    assert fit_success_curve(np.arange(10.0), np.arange(10) > 4).half is None


def test_interval_of_a_ratio_by_hand():
    """With an exact denominator, the interval is that of the numerator, divided; 1.96 is the normal quantile."""
    covariance = np.array([[0.25, 0.0], [0.0, 0.0]])
    assert compute_ratio_interval(6.0, 2.0, covariance) == pytest.approx((3 - 0.49, 3 + 0.49), abs=1e-4)
    uncertain = np.array([[0.25, 0.0], [0.0, 4.0]])
    assert compute_ratio_interval(6.0, 2.0, uncertain) == (-np.inf, np.inf)


def test_interval_covers_the_true_difficulty():
    """The interval contains the true value in about 95 % of repeated studies: at least 88 of 100."""
    rng, covered = np.random.default_rng(3), 0
    for _ in range(100):
        difficulty = rng.uniform(0, 10, 150)
        success = rng.uniform(size=150) < 1 / (1 + np.exp(-0.8 * (6 - difficulty)))
        curve = fit_success_curve(difficulty, success)
        covered += curve.low <= 6 <= curve.high
    assert covered >= 88
