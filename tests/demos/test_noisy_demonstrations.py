"""Demonstrations with action noise: corrections, replay, and determinism."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_hdf5 import INTENDED_ACTIONS
from robocas_ms3.demos.recordings.trajectory_json import read_json
from robocas_ms3.demos.settings import EpisodeSettings, ReplaySettings
from robocas_ms3.demos.trajectory_replay import replay
from robocas_ms3.robots.description import MOBILE_PANDA

pytestmark = pytest.mark.slow
NOISY = EpisodeSettings("pick", action_noise=(3.0, 1.0))
SEED = 1
FREE_STEPS = 30  # control steps before the gripper touches anything


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return the file of a demonstration with noise, and the environment that recorded it."""
    folder = tmp_path_factory.mktemp("noisy")
    generator = EpisodeGenerator(NOISY)
    assert generator.generate(SEED, folder, "one").success
    yield folder / "one.h5", generator.env
    generator.close()


def arm(states):
    return states[:, 13:25][:, MOBILE_PANDA.arm_slice]


def test_replay_of_the_executed_actions_is_exact(recorded):
    path, _ = recorded
    assert [(result.success, result.state_error) for result in replay(ReplaySettings(path))] == [(True, 0.0)]
    data = read_json(path)["episodes"][0]["robocas"]
    assert data["action_noise"] == [3.0, 1.0]
    assert data["check_rate"] is None


def test_intended_actions_lead_to_the_recorded_positions_without_the_recorded_deviations(recorded):
    path, env = recorded
    with TrajectoryFile(path) as file:
        recording = file.read_recording(0)
    with h5py.File(path) as file:
        intended = file[f"traj_0/{INTENDED_ACTIONS}"][:FREE_STEPS]
    assert np.abs(recording.actions[:FREE_STEPS] - intended).max() > 0.01
    env.reset(seed=SEED)
    positions = []
    for action in intended:
        env.step(action)
        positions.append(env.unwrapped.agent.robot.get_qpos()[0, MOBILE_PANDA.arm_slice].numpy())
    noisy = arm(recording.states["articulations"][MOBILE_PANDA.uid])[1 : FREE_STEPS + 1]
    error = noisy - np.array(positions) - recording.joint_deviations[:FREE_STEPS]
    at_samples = np.s_[3::4]  # at the states of a 5 Hz dataset
    assert error[at_samples].std() < 0.03 * recording.joint_deviations[:FREE_STEPS][at_samples].std()
    assert error.std() < 0.1 * recording.joint_deviations[:FREE_STEPS].std()


def test_noise_does_not_depend_on_how_attempts_are_undone(tmp_path):
    settings = replace(NOISY, task="search", config="search_table_small_heap", action_noise=(0.5, 0.2))
    found = []
    for fork in (True, False):
        generator = EpisodeGenerator(settings, fork=fork)
        assert generator.generate(3, tmp_path, str(fork)).success
        generator.close()
        with h5py.File(tmp_path / f"{fork}.h5") as file:
            found.append([file[f"traj_0/{name}"][()] for name in ("actions", INTENDED_ACTIONS, "joint_deviations")])
    for forked, resimulated in zip(*found, strict=True):
        np.testing.assert_array_equal(forked, resimulated)
