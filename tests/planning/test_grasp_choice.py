"""Grasp choice, by hand; see `grasp_poses`."""

from __future__ import annotations

import numpy as np
import pytest
from grasp_poses import BASE, CENTER, NO_POINTS, grasp

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.planning.grasp_choice import filter_grasps, rank_grasps
from robocas_ms3.scenes.grasping import SIDE_CLEARANCE, has_free_grasps


def test_filter_counts_what_fell_where_and_adds_the_turned_twin():
    poses = np.array(
        [grasp(), grasp(), grasp(100), grasp(40, 180), grasp(80, 0, 80), grasp(0, 0, 0, CENTER + [0, 0.1, 0])]
    )
    widths = np.array([0.05, 0.09, 0.05, 0.05, 0.05, 0.05])
    obstacle = CENTER + [0, 0.142, 0]  # in a pad of the last one
    kept = filter_grasps(
        poses,
        widths,
        arm_base_in_world=BASE,
        object_center_in_world=CENTER,
        scene_points_in_world=obstacle[None],
        qualities=np.arange(6.0),
    )
    assert kept.rejected == {
        "narrow_enough": 1,
        "from_above": 1,
        "from_the_robots_side": 1,
        "closing_is_level": 1,
        "gripper_is_clear": 1,
    }
    np.testing.assert_array_equal(kept.index, [0, 0])
    np.testing.assert_array_equal(kept.widths, [0.05, 0.05])
    assert len(kept) == 2
    np.testing.assert_allclose(kept.tcp_in_world[0], poses[0])
    np.testing.assert_allclose(kept.tcp_in_world[1][:3, 2:], poses[0][:3, 2:])  # same approach, same place
    np.testing.assert_allclose(kept.tcp_in_world[1][:3, :2], -poses[0][:3, :2])


def test_the_filter_knows_the_approach():
    poses = np.array([grasp(), grasp(91)])

    def index(approach):
        return filter_grasps(
            poses,
            np.array([0.05, 0.05]),
            arm_base_in_world=BASE,
            object_center_in_world=CENTER,
            scene_points_in_world=NO_POINTS,
            approach=approach,
        ).index.tolist()

    assert index("front") == [1, 1]
    assert index("top") == [0, 0]


def test_no_grasps_give_no_grasps():
    kept = filter_grasps(
        np.zeros((0, 4, 4)),
        np.zeros(0),
        arm_base_in_world=BASE,
        object_center_in_world=CENTER,
        scene_points_in_world=NO_POINTS,
    )
    assert len(kept) == 0 and kept.tcp_in_world.shape == (0, 4, 4)
    order = rank_grasps(
        kept.tcp_in_world,
        kept.qualities,
        object_center=CENTER,
        qpos=np.zeros((0, 7)),
        near=np.zeros(7),
        rng=np.random.default_rng(0),
    )
    assert len(order) == 0


class TestRanking:
    NEAR = np.zeros(7)

    def rank(self, poses, qualities, qpos=None, seed=0, temperature=0.0, approach="top"):
        qpos = np.zeros((len(poses), 7)) if qpos is None else qpos
        return rank_grasps(
            np.array(poses),
            np.array(qualities),
            object_center=CENTER,
            qpos=qpos,
            near=self.NEAR,
            rng=np.random.default_rng(seed),
            temperature=temperature,
            approach=approach,
        ).tolist()

    def test_quality(self):
        assert self.rank([grasp()] * 3, [0.2, 1.0, 0.6]) == [1, 2, 0]

    def test_distance_from_the_centre(self):
        assert self.rank([grasp(at=CENTER + [0.05, 0, 0]), grasp(), grasp(at=CENTER + [0, 0.02, 0])], [1, 1, 1]) == [
            1,
            2,
            0,
        ]

    def test_steepness(self):
        assert self.rank([grasp(60), grasp(0), grasp(30)], [1, 1, 1]) == [1, 2, 0]

    def test_from_the_front_level_grasps_come_first(self):
        # sines of 60, 0 and 90 deg times 0.7: 0.61, 0, 0.70
        assert self.rank([grasp(60), grasp(0), grasp(90)], [1, 1, 1], approach="front") == [2, 0, 1]

    def test_joint_space(self):
        qpos = np.zeros((3, 7))
        qpos[0, 6], qpos[2, 0] = 3.0, 1.0
        assert self.rank([grasp()] * 3, [1, 1, 1], qpos) == [1, 2, 0]

    def test_weights_by_hand(self):
        # 1 + 1 + 0.7 + 0.7 = 3.4 against 0.5 + 1 + 0.7 + 0.7 = 2.9 against 1 + 1 + 0.35 + 0.7 = 3.05
        assert self.rank([grasp(), grasp(), grasp(60)], [1.0, 0.5, 1.0]) == [0, 2, 1]

    def test_chance_differs_between_retries_and_repeats_with_the_seed(self):
        poses, qualities = [grasp()] * 20, [1.0] * 20
        orders = [self.rank(poses, qualities, seed=seed, temperature=0.15) for seed in (0, 0, 1)]
        assert orders[0] == orders[1] != orders[2]
        assert sorted(orders[0]) == list(range(20))

    def test_a_small_lead_loses_one_time_in_four(self):
        # Scores 0.15 apart at temperature 0.15: the lesser comes first with probability 1 / (1 + e) = 0.27.
        first = [self.rank([grasp()] * 2, [1.0, 0.85], seed=seed, temperature=0.15)[0] for seed in range(1000)]
        assert np.mean(first) == pytest.approx(1 / (1 + np.e), abs=0.04)


def test_batch_gives_the_counts_of_single_grasps():
    asset = load_pack("builtin").objects["sugar_box"]
    notes, pose = asset.annotations, np.eye(4)
    pose[:3] = notes.resting_poses[notes.display_pose][:3]
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.4, -0.4, -0.1), (0.4, 0.4, 0.6), (400, 3))
    points = points[np.linalg.norm(points[:, :2], axis=1) > 0.06]  # some are in the way of some grasps
    robot = np.array([0.0, -0.7])
    base = np.eye(4)
    base[:2, 3] = robot
    kept = filter_grasps(
        pose @ notes.grasps_tcp_in_object,
        notes.grasp_widths,
        arm_base_in_world=base,
        object_center_in_world=pose[:3, 3],
        scene_points_in_world=points,
        side_clearance=SIDE_CLEARANCE,
    )
    free = len(kept) // 2
    assert free > 0 and kept.rejected["gripper_is_clear"] > 0
    assert has_free_grasps(asset, pose, points, robot, at_least=free)
    assert not has_free_grasps(asset, pose, points, robot, at_least=free + 1)
    assert has_free_grasps(asset, pose, points, robot, at_least=0)
