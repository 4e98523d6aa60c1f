"""Actions played without any correction: those of a demonstration succeed again, spoiled ones do not."""

import numpy as np
import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.actions import episode_actions
from robocas_ms3.datasets.sources.arrays import episode_arrays
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.open_loop import OpenLoopEnv
from robocas_ms3.demos.recordings.motion import sample_states
from robocas_ms3.demos.recordings.subgoals import sample_subgoals
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.settings import EpisodeSettings

pytestmark = pytest.mark.slow
SEED = 1  # a light target: one that hangs heavily off the gripper bends the arm by millimetres


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A world to play in, a recording, and the actions that its trials played, one list a world."""
    generator = EpisodeGenerator(EpisodeSettings("pick", "pick_table_scattered", "builtin"))
    played = [[], []]

    def listen(world, actions):
        reset, step = world.reset, world.step

        def reset_(seed, options=None):
            actions.clear()
            reset(seed, options)

        def step_(action):
            actions.append(np.array(action))
            step(action)

        world.reset, world.step = reset_, step_
        return reset, step

    plain = [listen(world, actions) for world, actions in zip(generator.open_loop_envs, played, strict=True)]
    folder = tmp_path_factory.mktemp("recorded")
    assert generator.generate(SEED, folder, "one").success
    for world, (reset, step) in zip(generator.open_loop_envs, plain, strict=True):
        world.reset, world.step = reset, step
    with TrajectoryFile(folder / "one.h5") as file:
        yield generator.open_loop_envs[0], file.recording(0), [np.array(actions) for actions in played]
    generator.close()


def own_actions(recording):
    samples = sample_states(recording.control_steps, 4)
    goals = sample_subgoals(recording.subgoals, samples)
    arrays = episode_arrays(recording.motion(samples), recording.instruction, goals)
    return episode_actions(arrays)[:-1], arrays["ee_pos"]


def play(world, actions):
    world.reset(SEED)
    return world.replay(actions)


def test_a_demonstrations_own_actions_succeed_again(recorded):
    world, recording, _ = recorded
    actions, tcp = own_actions(recording)
    played = play(world, actions)
    assert played.success
    assert played.clipped == 0
    error = np.linalg.norm(played.tcp_in_base - tcp, axis=1)
    assert error.mean() < 0.002
    assert error.max() < 0.02


def test_a_trial_plays_what_a_dataset_will_hold_to_the_last_bit(recorded):
    _, recording, (clean, noisy) = recorded
    actions, _ = own_actions(recording)
    np.testing.assert_array_equal(clean, actions)
    difference = noisy - actions
    assert np.all(difference[:, 6] == 0)
    assert 3e-4 < difference[:, :3].std() < 7e-4  # 0.5 mm
    assert np.deg2rad(0.12) < difference[:, 3:6].std() < np.deg2rad(0.28)  # 0.2 deg


@pytest.mark.parametrize(("part", "value"), [(np.s_[:, 6], 1), (np.s_[:2, 0], 0.05)], ids=["open gripper", "beside"])
def test_spoilt_actions_do_not_succeed(recorded, part, value):
    world, recording, _ = recorded
    actions = own_actions(recording)[0].copy()
    actions[part] = value if value == 1 else actions[part] + value
    assert not play(world, actions).success


def test_motion_beyond_a_step_is_counted(recorded):
    world, *_ = recorded
    actions = np.array([[0, 0, -0.15, 0, 0, 0, 1], [0, 0, 0.01, 0, 0, 0, 1], [0, 0, 0, 0.4, 0, 0.4, 1]])
    played = play(world, actions)  # the last: 0.57 rad in one step
    assert len(world.layout.object_ids) == 10
    assert played.clipped == 2
    assert not played.success


@pytest.mark.parametrize("rate", [0, 2.5, 7])
def test_rates_that_physics_does_not_know(rate):
    with pytest.raises(DatasetError, match="cannot be replayed at this rate"):
        OpenLoopEnv({"env_id": "robocas_ms3:RoboCASPick-v1", "env_kwargs": {}}, rate)
