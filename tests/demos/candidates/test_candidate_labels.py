"""Clearing costs before and after a candidate, worked out by hand."""

import numpy as np
import pytest
from synthetic_candidates import ENV_INFO, SETTINGS, make_record

from robocas_ms3.demos.candidates.candidates_file import CandidateFile, write_candidates
from robocas_ms3.planning.clearing_cost import compute_clearing_cost


@pytest.mark.parametrize(
    ("obstacles", "hidden", "grasps", "cost"),
    [(0, 0.0, 5, 0), (1, 0.2, 1, 0), (3, 0.1, 1, 20), (0, 0.5, 1, 9), (0, 0.0, 0, 8), (2, 1.0, 0, 10 + 24 + 8)],
)
def test_clearing_cost(obstacles, hidden, grasps, cost):
    assert float(compute_clearing_cost(obstacles, hidden, grasps)) == pytest.approx(cost)


def test_clearing_cost_of_arrays():
    cost = compute_clearing_cost([[0, 3]], np.array([[np.nan, 0.2]]), [[-1, 0]])
    np.testing.assert_allclose(cost, [[np.nan, 28]])


def test_benefit_is_the_decrease_of_the_clearing_cost(tmp_path):
    record = make_record(3, 0, slots=2, candidates=3)
    record.values |= {"obstacles": [3, 0], "hidden_fraction": [0.4, 0.0], "free_grasps": [0, 9]}  # 34 and 0 s
    after = {"obstacles": [1, 2], "hidden_fraction": [0.4, 0.0], "free_grasps": [0, 9]}  # 14 and 10 s
    for candidate in record.candidates:
        candidate.update(after | {"held": False})
    record.candidates[1]["hidden_fraction"] = [0.975, 0.0]  # 31.25 s
    record.candidates[1]["fallen"] = [False, True]
    record.candidates[2]["obstacles"] = [3, 0]  # 34 s
    record.values["target_slot"] = 0
    write_candidates(tmp_path / "c.h5", [record], ENV_INFO, SETTINGS)
    labels = CandidateFile(tmp_path / "c.h5").labels
    np.testing.assert_allclose(labels.cost_before, [[34, 0]] * 3, atol=1e-5)
    np.testing.assert_allclose(labels.cost_after, [[14, 10], [31.25, 10], [34, 0]], atol=1e-5)
    np.testing.assert_allclose(labels.benefit, [[20, -10], [2.75, -10], [0, 0]], atol=1e-5)
    assert labels.helped.tolist() == [[True, False], [False, False], [False, False]]
    np.testing.assert_allclose(labels.for_target(labels.benefit), [20, 2.75, 0], atol=1e-5)


def test_candidates_that_drop_an_object_do_not_help(tmp_path):
    record = make_record(3, 0, slots=2, candidates=1)
    record.values |= {"obstacles": [3, 0], "hidden_fraction": [0.4, 0.0], "free_grasps": [0, 9]}
    record.candidates[0] |= {"obstacles": [0, 0], "hidden_fraction": [0.0, 0.0], "free_grasps": [9, 9]}
    record.candidates[0]["fallen"] = [False, True]
    write_candidates(tmp_path / "c.h5", [record], ENV_INFO, SETTINGS)
    assert not CandidateFile(tmp_path / "c.h5").labels.helped.any()


def test_held_and_delivered_objects_need_no_clearing(tmp_path):
    grasp, release = make_record(3, 0, slots=2, candidates=1), make_record(3, 1, slots=2, candidates=1)
    clutter = {"obstacles": [3, 0], "hidden_fraction": [0.0, 0.0], "free_grasps": [9, 9]}  # 20 and 0 s
    for record in (grasp, release):
        record.values |= clutter
        record.candidates[0] |= {"slot": 0, **clutter}
    grasp.candidates[0]["held"] = True
    release.values["held_slot"] = 0
    release.candidates[0]["in_basket"] = [True, False]
    write_candidates(tmp_path / "c.h5", [grasp, release], ENV_INFO, SETTINGS)
    labels = CandidateFile(tmp_path / "c.h5").labels
    assert labels.benefit.tolist() == [[20, 0], [0, 0]]
    assert labels.helped.tolist() == [[True, False], [False, False]]
