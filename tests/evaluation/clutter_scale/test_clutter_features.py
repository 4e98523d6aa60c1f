"""Features of scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.clutter_scale.features import FEATURES, make_features

SCENE = SceneDifficulty(
    seed=0,
    target="mug",
    objects=5,
    visible_fraction=0.75,
    obstacles=2,
    free_grasps=3,
    fewest_blockers=0,
    gap=0.025,
    removals=1,
    first_removals=[2],
    scripted_removal=2,
    simulated_removals=4,
    complete=True,
)


def test_values_by_hand():
    unsolved = replace(SCENE, removals=None, gap=0.2, free_grasps=0)
    features = make_features([SCENE, unsolved])
    assert features.shape == (2, len(FEATURES))
    assert dict(zip(FEATURES, features[0].tolist(), strict=True)) == {
        "removals": 1,
        "hidden_fraction": 0.25,
        "no_free_grasp": 0.25,
        "fewest_blockers": 0,
        "obstacles": 2,
        "closeness": 0.75,
    }
    np.testing.assert_array_equal(features[1], [np.nan, 0.25, 1, 0, 2, 0])


def test_no_scenes():
    assert make_features([]).shape == (0, len(FEATURES))
