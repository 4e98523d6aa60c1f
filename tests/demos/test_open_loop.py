"""Actions played without any correction: those of a demonstration succeed again, spoiled ones do not."""

import numpy as np
import pytest

from robocas_ms3.datasets.actions import episode_actions
from robocas_ms3.datasets.episode import episode_arrays, robot_frames, sample_subgoals
from robocas_ms3.datasets.trajectory import TrajectoryFile
from robocas_ms3.demos.episode import EpisodeGenerator, EpisodeSettings
from robocas_ms3.demos.open_loop import OpenLoop, Played
from robocas_ms3.demos.sampling import gripper_open, invert, sample_states, split_states
from robocas_ms3.errors import DatasetError
from robocas_ms3.robots.constants import FINGER_TARGETS
from robocas_ms3.robots.forward import link_poses

pytestmark = pytest.mark.slow
SEED = 2


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """What the generator's own trial is given, and what it found."""
    generator = EpisodeGenerator(EpisodeSettings("pick", "pick_table_scattered", "builtin"))
    assert generator.open_loop is not None
    play, calls = generator.open_loop.play_recording, []

    def listening(*args):
        calls.append((args, play(*args)))
        return calls[-1][1]

    generator.open_loop.play_recording = listening
    folder = tmp_path_factory.mktemp("recorded")
    result = generator.generate(SEED, folder, "one")
    assert result.success
    assert [args[4] is None for args, _ in calls] == [True, False]
    (args, played), *_ = calls
    yield generator.open_loop, args[:4], played, folder / "one.h5"
    generator.close()


def test_a_demonstrations_own_actions_succeed_again(recorded):
    _, (seed, states, gripper, control_freq), played, _ = recorded
    assert (seed, control_freq, len(states)) == (SEED, 20, len(gripper) + 1)
    assert played.success
    assert played.clipped == 0
    samples = [*range(0, len(gripper), 4), len(gripper)]
    tcp, base = link_poses(*split_states(states[samples])[:2])
    error = np.linalg.norm(played.tcp_in_base - (invert(base) @ tcp)[:, :3, 3], axis=1)
    assert error.mean() < 0.002
    assert error.max() < 0.02


def test_a_trial_plays_what_a_dataset_will_hold_to_the_last_bit(recorded, monkeypatch):
    open_loop, args, _, path = recorded
    played = []
    monkeypatch.setattr(open_loop, "play", played.append)
    open_loop.play_recording(*args)
    with TrajectoryFile(path) as file:
        recording = file.recording(0)
    samples = sample_states(recording.control_steps, 4)
    joints = recording.joints(samples)
    commands = recording.actions[:, 7]
    status = gripper_open(commands, samples, finger_range=FINGER_TARGETS, initial_width=joints.qpos[0, 10:].sum())
    goals = sample_subgoals(recording.subgoals, samples)
    arrays = episode_arrays(robot_frames(joints), joints, status, recording.instruction, goals)
    np.testing.assert_array_equal(played[0], episode_actions(arrays)[:-1])


def test_noise_moves_the_tcp_a_little(recorded):
    open_loop, args, played, _ = recorded
    noisy = open_loop.play_recording(*args, np.random.default_rng(0))
    difference = np.abs(noisy.tcp_in_base - played.tcp_in_base)[:20]  # before anything is touched
    assert 1e-6 < difference.max() < 3e-4
    again = open_loop.play_recording(*args, np.random.default_rng(0))
    np.testing.assert_array_equal(noisy.tcp_in_base, again.tcp_in_base)


def test_with_an_open_gripper_they_do_not(recorded):
    open_loop, (seed, states, gripper, control_freq), *_ = recorded
    assert not open_loop.play_recording(seed, states, np.ones_like(gripper), control_freq).success


def test_beside_the_object_they_do_not(recorded):
    open_loop, (seed, states, gripper, control_freq), *_ = recorded
    shifted = states.copy()
    shifted[8:, 13 + 3] += 0.2  # rad of the first joint of the arm, about 0.1 m at the hand
    assert not open_loop.play_recording(seed, shifted, gripper, control_freq).success


def test_motion_beyond_a_step_is_counted(recorded):
    open_loop, (seed, *_), *_ = recorded
    open_loop.reset(seed)
    assert len(open_loop.layout.object_ids) == 10
    actions = np.array([[0, 0, -0.15, 0, 0, 0, 1], [0, 0, 0.01, 0, 0, 0, 1], [0, 0, 0, 0.4, 0, 0.4, 1]])
    played = open_loop.play(actions)  # the last: 0.57 rad in one step
    assert played.clipped == 2
    assert not played.success


def test_where_objects_part_from_the_recording():
    still = np.zeros((4, 13), np.float32)
    moved = still[:, :3].copy()
    moved[1:, 0] = 0.009
    assert Played(False, np.zeros((4, 3)), 0, {"cup": moved, "can": still[:, :3]}).parted_at(
        {"cup": still, "can": still}
    ) == 4  # fmt: skip
    moved[2:, 1] = 0.005
    assert Played(False, np.zeros((4, 3)), 0, {"can": still[:, :3], "cup": moved}).parted_at(
        {"cup": still, "can": still}
    ) == 2  # fmt: skip


@pytest.mark.parametrize("rate", [0, 2.5, 7])
def test_rates_that_physics_does_not_know(rate):
    with pytest.raises(DatasetError, match="can't be played at this rate"):
        OpenLoop({"env_id": "robocas_ms3:RoboCASPick-v1", "env_kwargs": {}}, rate)
