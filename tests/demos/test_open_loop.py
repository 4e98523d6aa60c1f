"""Open-loop replay: actions of demonstrations succeed, modified actions fail."""

import numpy as np
import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.actions import compute_actions
from robocas_ms3.datasets.sources.arrays import make_episode_arrays
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
    """Return an open-loop environment, a recording, and the actions of its open-loop checks per environment."""
    generator = EpisodeGenerator(EpisodeSettings("pick", "pick_table_scattered", "builtin"))
    played = [[], []]

    def listen(env, actions):
        reset, step = env.reset, env.step

        def reset_(seed, options=None):
            actions.clear()
            reset(seed, options)

        def step_(action):
            actions.append(np.array(action))
            step(action)

        env.reset, env.step = reset_, step_
        return reset, step

    plain = [listen(env, actions) for env, actions in zip(generator.open_loop_envs, played, strict=True)]
    folder = tmp_path_factory.mktemp("recorded")
    assert generator.generate(SEED, folder, "one").success
    for env, (reset, step) in zip(generator.open_loop_envs, plain, strict=True):
        env.reset, env.step = reset, step
    with TrajectoryFile(folder / "one.h5") as file:
        yield generator.open_loop_envs[0], file.read_recording(0), [np.array(actions) for actions in played]
    generator.close()


def own_actions(recording):
    samples = sample_states(recording.control_steps, 4)
    goals = sample_subgoals(recording.subgoals, samples)
    arrays = make_episode_arrays(recording.compute_motion(samples), recording.instruction, goals)
    return compute_actions(arrays)[:-1], arrays["ee_pos"]


def play(env, actions):
    env.reset(SEED)
    return env.replay(actions)


def test_actions_of_a_demonstration_succeed_open_loop(recorded):
    env, recording, _ = recorded
    actions, tcp = own_actions(recording)
    played = play(env, actions)
    assert played.success
    assert played.clipped == 0
    error = np.linalg.norm(played.tcp_in_base - tcp, axis=1)
    assert error.mean() < 0.002
    assert error.max() < 0.02


def test_open_loop_check_replays_the_actions_of_the_dataset_bit_for_bit(recorded):
    _, recording, (clean, noisy) = recorded
    actions, _ = own_actions(recording)
    np.testing.assert_array_equal(clean, actions)
    difference = noisy - actions
    assert np.all(difference[:, 6] == 0)
    assert 3e-4 < difference[:, :3].std() < 7e-4  # 0.5 mm
    assert np.deg2rad(0.12) < difference[:, 3:6].std() < np.deg2rad(0.28)  # 0.2 deg


@pytest.mark.parametrize(("part", "value"), [(np.s_[:, 6], 1), (np.s_[:2, 0], 0.05)], ids=["open gripper", "beside"])
def test_modified_actions_do_not_succeed(recorded, part, value):
    env, recording, _ = recorded
    actions = own_actions(recording)[0].copy()
    actions[part] = value if value == 1 else actions[part] + value
    assert not play(env, actions).success


def test_clipped_actions_are_counted(recorded):
    env, *_ = recorded
    actions = np.array([[0, 0, -0.15, 0, 0, 0, 1], [0, 0, 0.01, 0, 0, 0, 1], [0, 0, 0, 0.4, 0, 0.4, 1]])
    played = play(env, actions)  # the last: 0.57 rad in one step
    assert len(env.layout.object_ids) == 10
    assert played.clipped == 2
    assert not played.success


@pytest.mark.parametrize("rate", [0, 2.5, 7])
def test_rate_that_does_not_divide_the_rate_of_physics_is_an_error(rate):
    with pytest.raises(DatasetError, match="unsupported rate of actions"):
        OpenLoopEnv({"env_id": "robocas_ms3:RoboCASPick-v1", "env_kwargs": {}}, rate)
