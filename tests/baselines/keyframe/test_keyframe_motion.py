"""Paths and views of `keyframe`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.arm_control import OPEN, ArmControl, EpisodeObservation
from robocas_ms3.baselines.keyframe.free_paths import FreePaths
from robocas_ms3.baselines.keyframe.front_approaches import Front, plan_front_approaches
from robocas_ms3.baselines.keyframe.handles import Handle
from robocas_ms3.baselines.keyframe.motion import LIFT, ArmPaths, PathFollower
from robocas_ms3.baselines.keyframe.tcp_poses import find_release_poses, find_views
from robocas_ms3.core.poses import from_rotation, inverse
from robocas_ms3.robots.registry import DEFAULT_ROBOT, find_robot
from robocas_ms3.scenes.grasp_checks import PREGRASP_DISTANCE

REST = np.array([0, np.pi / 8, 0, -5 * np.pi / 8, 0, 3 * np.pi / 4, np.pi / 4])
DOWN = Rotation.from_euler("x", np.pi).as_matrix()


@pytest.fixture(scope="module")
def paths():
    return ArmPaths(find_robot(DEFAULT_ROBOT))


def test_approach_ends_at_the_grasp_with_the_greatest_score(paths):
    grasps = from_rotation([[0.6, 0, 0.15], [0.55, 0.1, 0.15], [2.0, 0, 0.15]], np.stack([DOWN] * 3))
    approach = paths.plan_approach(grasps, np.array([0.1, 0.5, 0.9]), REST)
    ends = paths.chain.tcp(np.stack([approach.start, approach.path[-1]]))
    assert np.allclose(ends[1], approach.grasp, atol=1e-4)
    assert np.allclose(
        ends[0][:3, 3], [0.55, 0.1, 0.15 + PREGRASP_DISTANCE], atol=1e-4
    )  # the third grasp is out of reach
    assert paths.rise(approach.path[-1], approach.grasp, 0.15 + LIFT) is not None


def test_no_approach_out_of_reach(paths):
    assert paths.plan_approach(from_rotation([[2.0, 0, 0.2]], DOWN[None]), np.ones(1), REST) is None


def test_rise_moves_nearer_where_the_pose_above_is_out_of_reach(paths):
    far = from_rotation([0.72, 0, 0.2], DOWN)
    reachable, qpos = paths.reach(far[None], REST)
    assert reachable[0]
    path = paths.rise(qpos[0], far, 0.6)
    end = paths.chain.tcp(path[-1:])[0]
    assert end[2, 3] > 0.45 and np.linalg.norm(end[:2, 3]) < 0.72


def test_a_follower_reaches_the_end_of_a_path_in_limited_steps(paths):
    goal = REST + [0.8, 0, 0, 0, 0, 0, 0]
    path = paths.joint(REST, goal)
    follower, qpos, steps = PathFollower(paths.chain, path, 1), REST, 0
    poses = paths.chain.tcp(path)
    while not follower.is_last:
        here = paths.chain.tcp(qpos[None])[0]
        pose = follower.next_pose(here)
        motion = inverse(here) @ pose
        assert np.abs(motion[:3, 3]).max() < 0.1 and Rotation.from_matrix(motion[:3, :3]).magnitude() < 0.5
        qpos = path[int(np.abs(poses - pose).sum(axis=(1, 2)).argmin())]  # the arm follows exactly
        steps += 1
    assert np.allclose(qpos, goal) and 2 <= steps <= 20
    assert np.allclose(follower.goal, poses[-1])


def test_a_distant_path_is_approached_in_limited_steps_and_then_followed(paths):
    start = REST + [-0.8, 0, 0, 0, 0, 0, 0]
    path = paths.joint(REST + [0.2, 0, 0, 0, 0, 0, 0], REST + [0.6, 0, 0, 0, 0, 0, 0])
    here = paths.chain.tcp(start[None])[0]
    observation = EpisodeObservation(here, start, 0.08, {})
    motion = ArmControl(paths, 1).follow(observation, path, OPEN, speed=0.5)
    command, sizes = next(motion), []
    with pytest.raises(StopIteration) as ended:
        while True:
            sizes.append(np.abs(command.action[:3]).max())
            turn = Rotation.from_euler("xyz", command.action[3:6]).as_matrix()
            here = here @ from_rotation(command.action[:3], turn)  # the arm reaches each pose
            command = motion.send(EpisodeObservation(here, start, 0.08, {}))
    end = paths.chain.tcp(path[-1:])[0, :3, 3]
    assert np.linalg.norm(ended.value.value.tcp_in_base[:3, 3] - end) < 0.004
    assert len(sizes) > 8 and max(sizes) < 0.05


def test_motions_that_the_controller_refuses_are_shortened(paths):
    path = paths.joint(REST, REST + [0.8, 0, 0, 0, 0, 0, 0])
    follower, qpos, lengths, poses = PathFollower(paths.chain, path, 1), REST, [], paths.chain.tcp(path)
    for _ in range(40):
        here = paths.chain.tcp(qpos[None])[0]
        pose = follower.next_pose(here)
        lengths.append(np.linalg.norm(pose[:3, 3] - here[:3, 3]))
        if lengths[-1] < 0.06:  # the controller finds no joint positions for a longer motion
            qpos = path[int(np.abs(poses - pose).sum(axis=(1, 2)).argmin())]
    assert lengths[0] > 0.06 and np.allclose(qpos, path[-1])


def test_a_blocked_arm_does_not_advance(paths):
    path = paths.joint(REST, REST + [0.8, 0, 0, 0, 0, 0, 0])
    follower, here = PathFollower(paths.chain, path, 1), paths.chain.tcp(REST[None])[0]
    found = [follower.next_pose(here) for _ in range(10)]
    assert not follower.is_last and np.linalg.norm(found[-1][:3, 3] - here[:3, 3]) < 0.03


def test_grasps_in_reach(paths):
    tilted = Rotation.from_euler("y", 140, degrees=True).as_matrix()  # away from the base
    grasps = from_rotation([[0.6, 0, 0.15], [0.86, 0, 0.15], [0.86, 0, 0.15]], np.stack([DOWN, DOWN, tilted]))
    assert paths.is_grasp_in_reach(grasps, REST).tolist() == [True, False, True]
    assert paths.is_grasp_in_reach(grasps[:0], REST).shape == (0,)


def test_views_have_the_point_in_the_middle_of_the_image():
    camera_in_tcp = from_rotation([0.05, 0.0, -0.05], Rotation.from_euler("z", np.pi / 2).as_matrix())
    point = np.array([0.6, 0.1, 0.12])
    poses, costs = find_views(camera_in_tcp, point, (0.5, 0.4))
    in_camera = np.einsum("nij,j->ni", inverse(poses @ camera_in_tcp), [*point, 1])[:, :3]
    assert np.allclose(in_camera[:, :2], 0, atol=1e-9)
    assert set(np.round(in_camera[:, 2], 6)) == {0.5, 0.4}
    assert np.allclose((poses @ camera_in_tcp)[costs.argmin()][:3, 2], [0, 0, -1], atol=1e-9)  # straight down


def make_handle(motion):
    return Handle(np.array([0.475, -0.27, 0.08]), np.array(motion), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))


def test_pull_moves_the_handle_along_its_line(paths):
    handle = make_handle([0.0, 0.5, 0.0])
    pull = next(paths.plan_pulls(handle, REST))
    start = paths.chain.tcp(pull.start[None])[0]
    assert np.allclose(start[:3, 3] + 0.08 * start[:3, 2], handle.position, atol=1e-3)  # straight back from the handle
    held = paths.chain.tcp(pull.pull)
    assert np.allclose(held[0, :3, 3], handle.position, atol=1e-3)
    assert np.allclose(held[-1, :3, 3], handle.position + handle.motion, atol=1e-3)
    assert np.abs(held[:, [0, 2], 3] - held[0, [0, 2], 3]).max() < 1e-3
    assert np.abs(np.abs(held[:, 2, 0]) - 1).max() < 1e-2  # the gripper turns about the bar only
    away = paths.chain.tcp(paths.retreat(pull.pull[-1]))
    distances = np.linalg.norm(away[:, :3, 3] - held[-1, :3, 3], axis=1)
    along = (held[-1, :3, 3] - away[:, :3, 3]) @ held[
        -1, :3, 2
    ]  # against the approach, with the bar between the fingers
    assert distances[-1] > 0.05 and np.allclose(along, distances, atol=1e-3)


def test_a_pull_out_of_reach_is_as_long_as_possible(paths):
    pull = next(paths.plan_pulls(make_handle([0.0, 1.5, 0.0]), REST))
    end = paths.chain.tcp(pull.pull[-1:])[0, 1, 3]
    assert 0.2 < end < 0.9
    far = Handle(np.array([3.0, 0, 0]), np.array([0, 0.5, 0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))
    assert not list(paths.plan_pulls(far, REST))


@pytest.mark.parametrize(
    ("motion", "approach", "bar", "expected"),
    [
        ((0, 0.5, 0.03), (0.97, 0.1, 0), (0, 0.06, 0.97), True),  # a sliding door
        ((-0.3, 0, 0), (1, 0, 0), (0, 1, 0), True),  # a drawer
        ((0.01, 0, 0), (1, 0, 0), (0, 0, 1), False),  # it is open
        ((0.03, 0, 0.34), (1, 0, 0), (0, 0, 1), False),  # upwards
        ((0.4, 0, 0.1), (0.54, 0.23, -0.38), (0.11, -0.18, 0.95), False),  # short: cells contradict each other
        ((0, 0.5, 0), (1, 0, 0), (0.6, 0, 0.8), False),  # no grasp across the bar
        ((0.4, 0, 0), (1, 0, 0), (0, 0, 1), False),  # into the furniture
    ],
)
def test_a_handle_can_be_pulled_if_its_prediction_is_consistent(motion, approach, bar, expected):
    vectors = [np.array(vector, dtype=float) for vector in (motion, approach, bar)]
    assert Handle(np.array([0.5, 0.1, 0.2]), *vectors).can_be_pulled is expected


def plan_approaches(paths, grasps, front=None, is_clear=lambda path: True):
    scores = np.linspace(0.9, 0.5, len(grasps))
    return plan_front_approaches(paths, np.stack(grasps), scores, REST, front, is_clear)


def test_front_approach_enters_and_leaves_a_compartment(paths):
    approach = np.array([np.sin(1.2), 0, -np.cos(1.2)])  # 69 degrees from the vertical
    closing = np.array([0.0, 1.0, 0.0])
    grasp = from_rotation([0.65, -0.05, 0.2], np.stack([np.cross(closing, approach), closing, approach], axis=1))
    far = from_rotation([2.0, 0, 0.2], grasp[:3, :3])
    found = next(
        plan_front_approaches(paths, np.stack([far, grasp]), np.array([0.9, 0.5]), REST, None, lambda path: True)
    )
    assert np.allclose(found.grasp[:3, 3], grasp[:3, 3])
    outside, inside, after = paths.chain.tcp(np.stack([found.start, found.path[-1], found.exit_path[-1]]))
    assert np.allclose(inside, found.grasp, atol=1e-3)
    assert outside[0, 3] < 0.65 - 0.15 and after[0, 3] < 0.65 - 0.15  # 6 cm or more before the pre-grasp
    heights = paths.chain.tcp(found.exit_path)[:, 2, 3]
    assert heights.min() > 0.199 and after[2, 3] == pytest.approx(outside[2, 3] + 0.025, abs=1e-3)


def test_points_before_a_front_are_outside():
    front = Front.from_handle(Handle(np.array([0.5, 0.1, 0.2]), np.zeros(3), np.array([0.6, 0, 0.8]), np.ones(3)))
    assert np.allclose(front.inwards, [1, 0, 0]) and np.allclose(front.position, [0.38, 0.1, 0.2])  # 12 cm before it
    assert np.allclose(front.depths(np.array([[0.5, 0.3, 0.9], [0.3, 0, 0]])), [0.12, -0.08])
    poses = from_rotation([[0.5, 0.3, 0.9], [0.3, 0, 0]], np.stack([DOWN] * 2))
    assert np.allclose(front.move_out(poses)[:, :3, 3], [[0.38, 0.3, 0.9], [0.3, 0, 0]])


def test_the_way_out_of_a_compartment_ends_before_its_front(paths):
    """A grasp at an angle leads back along the front, so that the gripper has to move on perpendicularly to it."""
    approach = np.array([np.sin(1.2) * 0.6, np.sin(1.2) * 0.8, -np.cos(1.2)])
    closing = np.array([0.8, -0.6, 0.0])
    grasp = from_rotation([0.62, 0.05, 0.2], np.stack([np.cross(closing, approach), closing, approach], axis=1))
    front = Front(np.array([0.32, 0, 0]), np.array([1.0, 0, 0]))
    ends = [next(plan_approaches(paths, [grasp], of)).exit_path[-1] for of in (None, front)]
    inside, outside = paths.chain.tcp(np.stack(ends))[:, 0, 3]
    assert inside > 0.38 and outside == pytest.approx(0.32, abs=1e-3)


def test_approaches_through_obstacles_come_last(paths):
    approach, closing = np.array([np.sin(1.2), 0, -np.cos(1.2)]), np.array([0.0, 1.0, 0.0])
    rotation = np.stack([np.cross(closing, approach), closing, approach], axis=1)
    grasps = [from_rotation([0.65, y, 0.2], rotation) for y in (-0.2, 0.2)]

    def is_clear(path):
        tcp = paths.chain.tcp(path)[:, :3, 3]
        assert np.linalg.norm(tcp - [0.65, -0.2 if tcp[0, 1] < 0 else 0.2, 0.2], axis=1).min() > PREGRASP_DISTANCE
        return bool((tcp[:, 1] > 0).all())

    found = [one.grasp[1, 3] for one in plan_approaches(paths, grasps, is_clear=is_clear)]
    assert found[0] == 0.2 and -0.2 in found[1:]  # although its score is greater


def test_release_poses_tilt_away_from_the_base():
    point = np.array([0.3, 0.4, 0.4])
    poses, costs = find_release_poses(point)
    assert np.allclose(poses[costs.argmin()][:3, 2], [0, 0, -1]) and np.allclose(poses[costs.argmin()][:3, 3], point)
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)
    assert (poses[:, :3, 2] @ [0.6, 0.8, 0] >= -1e-9).all()  # outward, along the direction of the point
    assert np.linalg.norm(poses[:, :3, 3] - point, axis=1).max() == pytest.approx(0.05)
    # an object that was upright in a grasp 60 degrees from the vertical stays upright
    tilt = np.deg2rad(60)
    upright = np.array([np.sin(tilt), 0, -np.cos(tilt)])  # the vertical in the TCP frame
    poses, costs = find_release_poses(point, upright)
    assert costs.min() < 0.01 and np.allclose(poses[costs.argmin()][:3, :3] @ upright, [0, 0, 1], atol=0.01)


def test_free_paths_avoid_points(paths):
    free = FreePaths(paths, REST)
    first, last = (REST + [turn, 0.3, 0, 0, 0, 0, 0] for turn in (0.9, -0.9))
    direct = free.find_path(first, last)
    assert np.allclose(direct, paths.joint(first, last))  # nothing to avoid
    poses = paths.chain.tcp(direct)
    middle = poses[len(direct) // 2][:3, 3]
    free.set_points(middle + np.random.default_rng(0).normal(0, 0.01, (200, 3)))
    found = free.find_path(first, last)
    assert found is None or np.abs(found - REST).max(axis=1).min() < 1e-9  # by the rest configuration
    near = first + [0.05, 0, 0, 0, 0, 0, 0]
    chosen, path = free.choose(first, [last, near] if found is None else [near], lambda qpos: qpos)
    assert chosen is near and np.allclose(path[-1], near)
    assert free.choose(first, [], lambda qpos: qpos) is None
    _, path = free.choose(first, [near], lambda qpos: qpos, by_rest=True)
    assert np.abs(path - REST).max(axis=1).min() < 1e-9 and np.allclose(path[-1], near)


def test_a_held_object_avoids_points(paths):
    """A post under the path is clear of the gripper, but not of an object that hangs 10 cm below it."""
    free = FreePaths(paths, REST)
    first, last = (REST + [turn, 0, 0, 0, 0, 0, 0] for turn in (0.9, -0.9))
    grasp = paths.chain.tcp(first[None])[0]
    middle = paths.chain.tcp(REST[None])[0, :3, 3]
    post = middle - [0, 0, 0.1] + np.random.default_rng(0).uniform(-0.005, 0.005, (50, 3))
    free.set_points(post)
    assert free.find_path(first, last) is not None
    free.hold(grasp[:3, 3] - [0, 0, 0.1] + np.linspace(-0.02, 0.02, 20)[:, None] * [0, 0, 1.0], grasp)
    assert free.find_path(first, last) is None
    free.release()
    assert free.find_path(first, last) is not None
