"""Grasp choice compared with values computed by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from grasp_poses import BASE, CENTER, grasp

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.poses import inverse
from robocas_ms3.planning.grasp_choice import filter_grasps, sample_grasp_order, score_grasps
from robocas_ms3.scenes.grasp_checks import SIDE_CLEARANCE, has_free_grasps, is_gripper_clear

OBJECT = np.eye(4)
OBJECT[:3, 3] = CENTER


def filtered(poses, widths, approach="top"):
    count = len(poses)
    in_object = inverse(OBJECT) @ np.array(poses).reshape(-1, 4, 4)
    notes: object = SimpleNamespace(
        grasps_tcp_in_object=in_object, grasp_widths=np.array(widths), grasp_qualities=np.full(count, 0.3)
    )
    return filter_grasps(notes, OBJECT, BASE, approach)  # pyright: ignore[reportArgumentType]


def test_grasps_from_the_approach_side_are_kept_with_a_half_turn():
    poses = [grasp(), grasp(), grasp(100), grasp(40, 180), grasp(80, 0, 80)]
    kept = filtered(poses, [0.05, 0.09, 0.05, 0.05, 0.05])  # too wide, from below, from behind, closing not level
    np.testing.assert_array_equal(kept.index, [0, 0])
    np.testing.assert_array_equal(kept.widths, [0.05, 0.05])
    np.testing.assert_allclose(kept.qualities, 0.8)
    np.testing.assert_allclose(kept.tcp_in_world[0], poses[0], atol=1e-12)
    np.testing.assert_allclose(kept.tcp_in_world[1][:3, 2:], poses[0][:3, 2:], atol=1e-12)  # same approach, same place
    np.testing.assert_allclose(kept.tcp_in_world[1][:3, :2], -poses[0][:3, :2], atol=1e-12)
    assert len(filtered([], [])) == 0
    for approach, index in (("front", [1, 1]), ("top", [0, 0])):
        assert filtered([grasp(), grasp(91)], [0.05, 0.05], approach).index.tolist() == index


@pytest.mark.parametrize(
    ("poses", "qualities", "turns", "approach", "order"),
    [
        ([grasp()] * 3, [0.2, 1.0, 0.6], 0, "top", [1, 2, 0]),
        ([grasp(at=CENTER + [0.05, 0, 0]), grasp(), grasp(at=CENTER + [0, 0.02, 0])], 1, 0, "top", [1, 2, 0]),
        ([grasp(60), grasp(0), grasp(30)], 1, 0, "top", [1, 2, 0]),
        # sines of 60, 0 and 90 deg times 0.7: 0.61, 0, 0.70
        ([grasp(60), grasp(0), grasp(90)], 1, 0, "front", [2, 0, 1]),
        ([grasp()] * 3, 1, [3.0, 0, 1.0], "top", [1, 2, 0]),
        # 1 + 1 + 0.7 = 2.7 against 0.5 + 1 + 0.7 = 2.2 against 1 + 1 + 0.35 = 2.35
        ([grasp(), grasp(), grasp(60)], [1.0, 0.5, 1.0], 0, "top", [0, 2, 1]),
    ],
    ids=["quality", "distance from the centre", "steepness", "level from the front", "joint space", "weights"],
)
def test_scores(poses, qualities, turns, approach, order):
    count = len(poses)
    qualities, turns = np.broadcast_to(qualities, count), np.broadcast_to(turns, count)
    scores = score_grasps(np.array(poses), qualities, np.zeros(count), turns, CENTER, approach)
    assert np.argsort(-scores, kind="stable").tolist() == order


def test_order_depends_on_the_random_generator_only():
    orders = [sample_grasp_order(np.random.default_rng(seed), np.ones(20)).tolist() for seed in (0, 0, 1)]
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == list(range(20))
    # Scores 0.15 apart at temperature 0.15: the lesser comes first with probability 1 / (1 + e) = 0.27.
    first = [sample_grasp_order(np.random.default_rng(seed), np.array([1.0, 0.85]))[0] for seed in range(1000)]
    assert np.mean(first) == pytest.approx(1 / (1 + np.e), abs=0.04)


def test_batches_of_grasps_give_the_counts_of_single_grasps():
    asset = load_pack("builtin").objects["sugar_box"]
    notes, pose = asset.annotations, np.eye(4)
    pose[:3] = notes.resting_poses[notes.display_pose][:3]
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.4, -0.4, -0.1), (0.4, 0.4, 0.6), (400, 3))
    points = points[np.linalg.norm(points[:, :2], axis=1) > 0.06]  # some are in the way of some grasps
    base = np.eye(4)
    base[1, 3] = -0.7
    kept = filter_grasps(notes, pose, base)
    clear = is_gripper_clear(kept.tcp_in_world, points, side_clearance=SIDE_CLEARANCE)
    free = int(clear.sum()) // 2
    assert 0 < free < len(kept) // 2
    for least, found in ((0, True), (free, True), (free + 1, False)):
        assert has_free_grasps(asset, pose, points, base[:2, 3], min_count=least) == found
