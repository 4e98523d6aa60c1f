from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.datasets.schema import EPISODE_INFO
from robocas_ms3.datasets.sources.arrays import add_embeddings, make_episode_arrays
from robocas_ms3.demos.recordings.motion import (
    Motion,
    compute_agv_pose,
    sample_gripper_commands,
    sample_states,
    sample_stride,
)
from robocas_ms3.demos.recordings.subgoals import SubGoal, sample_subgoals
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.quantities import to_continuous_xyzw


@st.composite
def pose_sequences(draw):
    """(T, 4, 4) random poses, T from 2 to 30."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(2, 30))
    return from_xyzw(rng.uniform(-2, 2, (count, 3)), Rotation.random(count, random_state=rng).as_quat())


def compose(first, relative):
    """Poses (T, 4, 4) of the first one and the relative motion (T, 4, 4)."""
    return np.stack(list(accumulate(relative[:-1], np.matmul, initial=first)))


@settings(max_examples=50, deadline=None)
@given(pose_sequences(), pose_sequences())
def test_relative_motion_composes_to_the_poses(tcp, base):
    count = min(len(tcp), len(base))
    arrays = arrays_of(tcp[:count], base[:count])
    for position, orientation, rel_position, rel_orientation in (
        ("ee_pos", "ee_orn", "rel_pos", "rel_orn"),
        ("base_pos", "base_orn", "base_rel_pos", "base_rel_orn"),
    ):
        absolute = from_xyzw(arrays[position], arrays[orientation])
        relative = from_xyzw(arrays[rel_position], arrays[rel_orientation])
        np.testing.assert_allclose(compose(absolute[0], relative), absolute, atol=1e-4)  # float32


def test_orientations_have_continuous_signs():
    turns = Rotation.from_euler("z", np.linspace(0, 720, 60)[:, None], degrees=True)
    poses = from_xyzw(np.zeros((60, 3)), turns.as_quat())
    quaternions = to_continuous_xyzw(poses)
    assert quaternions[0, 3] > 0
    assert np.sum(quaternions[1:] * quaternions[:-1], axis=1).min() > 0.99
    np.testing.assert_allclose(Rotation.from_quat(quaternions).as_matrix(), poses[:, :3, :3], atol=1e-12)


def arrays_of(tcp, base, *, qpos=None, subgoals=None, embed=None):
    count = len(tcp)
    qpos = np.zeros((count, 12)) if qpos is None else qpos
    root = np.broadcast_to(np.eye(4), (count, 4, 4))
    motion = Motion(qpos, np.zeros((count, 12)), root, tcp, base, np.ones(count, bool))
    subgoals = subgoals or [SubGoal.from_range("move and grasp", "grasp it", 0, count - 1)]
    arrays = make_episode_arrays(motion, "do it", subgoals)
    return add_embeddings(arrays, embed) if embed else arrays


def test_relative_motion_is_in_the_eef_frame():
    # The hand points down (x axis as the world's, y and z turned round) and moves 10 cm down: along its own +z.
    down = Rotation.from_euler("x", 180, degrees=True).as_quat()
    tcp = from_xyzw(np.array([[0.5, 0.2, 0.9], [0.5, 0.2, 0.8]]), np.array([down, down]))
    base = from_xyzw(np.tile([0.1, 0.2, 0.4], (2, 1)), np.tile([0.0, 0, 0, 1], (2, 1)))
    arrays = arrays_of(tcp, base)
    np.testing.assert_allclose(arrays["rel_pos"], [[0, 0, 0.1], [0, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(arrays["rel_orn"], [[0, 0, 0, 1], [0, 0, 0, 1]], atol=1e-7)
    np.testing.assert_allclose(arrays["ee_pos"], [[0.4, 0, 0.5], [0.4, 0, 0.4]], atol=1e-7)
    np.testing.assert_allclose(np.abs(arrays["ee_orn"]), [[1, 0, 0, 0]] * 2, atol=1e-7)
    np.testing.assert_allclose(arrays["base_pos"], [[0.1, 0.2, 0.4]] * 2, atol=1e-7)


def test_arrays_have_the_declared_types_and_shapes():
    poses = np.broadcast_to(np.eye(4), (5, 4, 4))
    qpos = np.arange(60.0).reshape(5, 12)
    goals = [
        SubGoal.from_range("move and grasp", "grasp it", 0, 1),
        SubGoal.from_range("transfer object", "drop it", 2, 4),
    ]
    arrays = arrays_of(poses, poses, qpos=qpos, subgoals=goals, embed=lambda texts: np.ones((len(texts), 384)))
    required = [spec for spec in EPISODE_INFO if not spec.optional]
    assert list(arrays) == [spec.name for spec in required]
    for spec in required:
        assert spec.has_dtype(arrays[spec.name]), spec.name
        assert arrays[spec.name].shape == spec.shape_for(5), spec.name
    assert arrays["step_goal_type"].tolist() == ["move and grasp"] * 2 + ["transfer object"] * 3
    assert arrays["step_lang_goals"].tolist() == ["grasp it"] * 2 + ["drop it"] * 3
    np.testing.assert_array_equal(arrays["robot_joints"][0], [3, 4, 5, 6, 7, 8, 9])
    assert arrays["gripper_width"][0] == 21  # fingers 10 and 11
    assert arrays["episode_length"] == 5
    assert str(arrays["language_goal"]) == "do it"


def test_base_pose_in_the_world():
    # The root is at (0.7, 0.15) turned by 90 deg: 0.2 along its x is 0.2 along the world's y.
    root = from_xyzw(np.array([[0.7, 0.15, 0]] * 2), Rotation.from_euler("z", [[90], [90]], degrees=True).as_quat())
    qpos = np.zeros((2, 12))
    qpos[1, :3] = 0.2, 0.0, np.deg2rad(100)
    expected = [[0.7, 0.15, np.pi / 2], [0.7, 0.35, np.deg2rad(190)]]  # on from 90, not to -170
    np.testing.assert_allclose(compute_agv_pose(root, qpos), expected, atol=1e-12)


def test_base_yaw_is_continuous():
    poses = np.broadcast_to(np.eye(4), (2, 4, 4))
    qpos = np.zeros((2, 12))
    qpos[:, 2] = np.deg2rad([170, 190])
    np.testing.assert_allclose(arrays_of(poses, poses, qpos=qpos)["rel_agv_pose"][0, 2], np.deg2rad(20), atol=1e-6)


@pytest.mark.parametrize(
    ("steps", "stride", "expected"),
    [(8, 4, [0, 4, 8]), (9, 4, [0, 4, 8, 9]), (3, 4, [0, 3]), (4, 1, [0, 1, 2, 3, 4]), (1, 4, [0, 1])],
)
def test_last_state_is_always_sampled(steps, stride, expected):
    assert sample_states(steps, stride).tolist() == expected


def test_strides():
    assert sample_stride(20, 5) == 4
    assert sample_stride(5, 5) == 1
    for rate in (3, 0, -5, 40):
        with pytest.raises(DatasetError, match="one of 20, 10, 5, 4, 2, 1 Hz at 20 Hz") as caught:
            sample_stride(20, rate)
        assert caught.value.usage


def test_step_belongs_to_the_action_that_starts_there():
    goals = [SubGoal.from_range("move and grasp", "a", 0, 4), SubGoal.from_range("transfer object", "b", 5, 9)]
    # States 0, 4 precede actions 0, 4 of the first goal; 8 and the end belong to the second.
    assert [(g.goal_type, g.first, g.last) for g in sample_subgoals(goals, sample_states(10, 4))] == [
        ("move and grasp", 0, 1),
        ("transfer object", 2, 3),
    ]


def test_sub_goal_between_two_samples_is_omitted():
    goals = [
        SubGoal.from_range("move and grasp", "a", 0, 4),
        SubGoal.from_range("lift object", "b", 5, 7),
        SubGoal.from_range("transfer object", "c", 8, 9),
    ]
    sampled = sample_subgoals(goals, sample_states(10, 4))
    assert [(g.goal_description, g.first, g.last) for g in sampled] == [("a", 0, 1), ("c", 2, 3)]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 12), min_size=1, max_size=6), st.integers(1, 6))
def test_sampled_sub_goals_cover_all_steps(lengths, stride):
    firsts = np.concatenate([[0], np.cumsum(lengths)])
    goals = [
        SubGoal.from_range("move and grasp", str(i), int(a), int(b) - 1)
        for i, (a, b) in enumerate(zip(firsts[:-1], firsts[1:], strict=True))
    ]
    samples = sample_states(sum(lengths), stride)
    covered = [step for goal in sample_subgoals(goals, samples) for step in range(goal.first, goal.last + 1)]
    assert covered == list(range(len(samples)))


@pytest.mark.parametrize("ranges", [[(0, 4), (6, 9)], [(1, 9)], [(0, 8)], [(0, 12)], [(0, 5), (4, 9)], []])
def test_sub_goals_with_gaps_are_refused(ranges):
    goals = [SubGoal.from_range("move and grasp", "a", first, last) for first, last in ranges]
    with pytest.raises(DatasetError, match="ranges from 0 to 9"):
        sample_subgoals(goals, sample_states(10, 4))


def test_gripper_status_is_the_previous_command():
    # Fingers go to -0.01 + (a + 1) / 2 * 0.05 m each: open (> 0.02 m) above a = 0.2.
    commands = np.array([1, 1, 1, -1, -1, 0.1, 0.3, 1], float)
    samples = np.array([0, 3, 4, 6, 7, 8])
    status = sample_gripper_commands(MOBILE_PANDA, commands, samples, initial_width=0.08)
    assert status.tolist() == [True, True, False, False, True, True]
    assert not sample_gripper_commands(MOBILE_PANDA, commands, samples, initial_width=0.0)[0]
