"""Grasp choice, by hand: the arm's base at the origin, the object 0.5 m in front of it (along x)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.scenes.grasping import (
    SIDE_CLEARANCE,
    directions_ok,
    filter_grasps,
    gripper_is_clear,
    has_free_grasps,
    rank_grasps,
)

BASE = np.eye(4)
CENTER = np.array([0.5, 0.0, 0.05])
NO_POINTS = np.zeros((0, 3))


def grasp(lean_deg=0.0, heading_deg=0.0, closing_deg=0.0, at=CENTER):
    """A grasp leaning from straight down towards a heading, turned by ``closing_deg`` about its own approach."""
    heading = np.deg2rad(heading_deg)
    across = np.array([-np.sin(heading), np.cos(heading), 0.0])
    down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    turn = (
        Rotation.from_rotvec(-np.deg2rad(lean_deg) * across)
        * down
        * Rotation.from_euler("z", closing_deg, degrees=True)
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), at
    return pose


def directions_of(pose):
    return {name: bool(passed[0]) for name, passed in directions_ok(pose[None], CENTER).items()}


def test_the_helper_leans_where_it_says():
    np.testing.assert_allclose(grasp(30, 0)[:3, 2], [0.5, 0, -np.sqrt(0.75)], atol=1e-12)
    np.testing.assert_allclose(grasp(90, 90)[:3, 2], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("lean", "heading", "from_above", "from_the_robots_side"),
    [
        (0, 0, True, True),  # straight down comes from no side
        (10, 180, True, True),  # hardly leaning
        (20, 180, True, False),  # from behind the object
        (30, 0, True, True),
        (30, 44, True, True),
        (30, 46, True, False),
        (60, -44, True, True),
        (89, 0, True, True),
        (91, 0, False, True),  # upwards
    ],
)
def test_approach_directions(lean, heading, from_above, from_the_robots_side):
    found = directions_of(grasp(lean, heading))
    assert (found["from_above"], found["from_the_robots_side"]) == (from_above, from_the_robots_side)


def test_the_direction_turns_with_the_object():
    sideways = grasp(30, 90)
    assert directions_ok(sideways[None], np.array([0.0, 0.5, -0.4]))["from_the_robots_side"][0]
    assert not directions_ok(sideways[None], np.array([0.5, 0.0, -0.4]))["from_the_robots_side"][0]


@pytest.mark.parametrize(
    ("lean", "heading", "from_the_front", "from_the_robots_side"),
    [
        (90, 0, True, True),  # level
        (31, 0, True, True),  # 59 deg down
        (29, 0, False, True),  # 61 deg down
        (99, 0, True, True),  # 9 deg up
        (101, 0, False, True),
        (90, 44, True, True),
        (90, 46, True, False),
        (40, -46, True, False),
        (90, 180, True, False),  # from behind the object
        (0, 0, False, True),  # straight down: no side, so none to object to
        (10, 180, False, False),  # nothing is let pass for leaning little
    ],
)
def test_front_approach_directions(lean, heading, from_the_front, from_the_robots_side):
    found = directions_ok(grasp(lean, heading)[None], CENTER, "front")
    assert list(found) == ["from_the_front", "from_the_robots_side", "closing_is_level"]
    assert (found["from_the_front"][0], found["from_the_robots_side"][0]) == (from_the_front, from_the_robots_side)


@pytest.mark.parametrize(
    ("closing", "level"), [(0, True), (59, True), (61, False), (90, False), (119, False), (121, True)]
)
def test_the_closing_axis_may_tilt_by_60_degrees(closing, level):
    # An approach along x: turning about it by c tilts the closing axis (y) by c from the horizontal.
    assert directions_of(grasp(90, 0, closing))["closing_is_level"] is level


@pytest.mark.parametrize(
    ("point", "clear"),
    [
        ((0.0, 0.0, 0.0), True),  # between the pads
        ((0.0, 0.039, 0.0), True),
        ((0.0, 0.042, 0.0), False),  # in a pad
        ((0.0, -0.042, 0.008), False),  # at the other pad's end, 8 mm beyond the TCP
        ((0.0, 0.042, 0.010), True),  # just below it
        ((0.011, 0.042, 0.0), True),  # beside it
        ((0.0, 0.055, 0.0), True),  # outside of it
        ((0.0, 0.055, -0.05), False),  # in the knuckle
        ((0.0, 0.0, -0.06), True),  # under the palm
        ((0.0, 0.0, -0.07), False),  # in the palm
        ((0.03, -0.10, -0.1), False),
        ((0.03, -0.11, -0.1), True),
        ((0.0, 0.042, -0.12), False),  # swept by a pad and now in the palm
        ((0.0, 0.0, -0.25), False),  # swept by the palm
        ((0.0, 0.0, -0.29), True),  # above the pre-grasp's palm
    ],
)
def test_points_in_the_open_gripper(point, clear):
    for turn in (0, 180):
        pose = grasp(30, 10, turn)
        inside = pose[:3, :3] @ (np.array(point) * ([1, 1, 1] if turn == 0 else [-1, -1, 1])) + pose[:3, 3]
        assert gripper_is_clear(pose[None], inside[None])[0] == clear


def test_many_grasps_among_many_points_are_judged_as_each_alone():
    rng = np.random.default_rng(0)
    grasps = np.stack([grasp(*rng.uniform(-60, 60, 3)) for _ in range(40)])
    grasps[:, :3, 3] += rng.uniform(-0.3, 0.3, (40, 3))
    points = rng.uniform(-0.6, 0.6, (300, 3)) + grasp()[:3, 3]
    expected = []
    for pose in grasps:
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        in_tip = (abs(x) <= 0.01) & (abs(abs(y) - 0.043) <= 0.003) & (z >= -0.14) & (z <= 0.0085)
        in_knuckle = (abs(x) <= 0.012) & (abs(abs(y) - 0.0535) <= 0.0135) & (z >= -0.175) & (z <= -0.02)
        in_palm = (abs(x) <= 0.033) & (abs(y) <= 0.104) & (z >= -0.28) & (z <= -0.067)
        expected.append(not (in_tip | in_knuckle | in_palm).any())
    assert 0 < sum(expected) < 40
    assert gripper_is_clear(grasps, points).tolist() == expected


def test_without_a_sweep_only_the_grasp_itself_counts():
    above = grasp()[:3, 3] + [0, 0.042, 0.2]  # 0.2 m above the pad
    assert not gripper_is_clear(grasp()[None], above[None], sweep=0.1)[0]
    assert gripper_is_clear(grasp()[None], above[None], sweep=0.0)[0]


@pytest.mark.parametrize(
    ("point", "clear"),
    [
        ((0.0, 0.050, 0.0), False),  # 4 mm outside of a pad, which ends at y = 46 mm
        ((0.0, 0.052, 0.0), True),
        ((0.014, 0.042, 0.0), False),  # 4 mm beside it
        ((0.016, 0.042, 0.0), True),
        ((0.0, 0.042, 0.010), True),  # below it: its sides alone leave room
    ],
)
def test_a_free_grasp_leaves_room_at_its_sides(point, clear):
    pose = grasp(30, 10)
    there = pose[:3, :3] @ np.array(point) + pose[:3, 3]
    assert gripper_is_clear(pose[None], there[None], side_clearance=0.005)[0] == clear


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


def test_nothing_in_nothing_out():
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


def test_a_batch_of_grasps_is_counted_as_one_by_one():
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
