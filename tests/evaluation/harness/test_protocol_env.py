"""A task of a protocol as a vector environment in LeRobot's conventions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from counting_env import POSE
from short_protocols import shorten

from robocas_ms3.core.errors import EvaluationError, RobocasError
from robocas_ms3.core.locks import lock_folder
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.evaluation.harness.protocol_env import ProtocolVectorEnv
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.result_files import read_result
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

SMOKE = load_protocol("smoke")
SPEC = PolicySpec(reference="tcp", rate_hz=5, cameras={"base_camera": (6, 4)}, depth=True)


@pytest.fixture
def make(made):
    """Factory of environments without physics; closes them at the end."""
    envs = []

    def make(num_envs=2, task="pick", spec=SPEC, protocol="smoke", **settings):
        settings = {"backend": "processes", **settings}
        settings = EvaluationSettings((task,), "mine", protocol, envs=num_envs, **settings)
        envs.append(ProtocolVectorEnv(spec, settings))
        return envs[-1]

    yield make
    for env in envs:
        env.close()
    assert all(env.closed for env in made)


def act(*sums: float, gripper: float = 0.0) -> np.ndarray:
    actions = np.zeros((len(sums), 7), np.float32)
    actions[:, 0], actions[:, 6] = sums, gripper
    return actions


def test_observations_are_in_the_declared_space_and_have_the_datasets_names(make):
    env = make()
    with pytest.raises(EvaluationError, match="Call reset before step"):
        env.step(act(0, 0))
    obs, info = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    state = {"agent_pos", "joint_velocity", "arm_base", "gripper_open"}
    calibration = {"intrinsics.base_camera", "camera_in_base.base_camera"}
    assert set(obs) == {"pixels", "images.base_camera_depth", *state, *calibration}
    assert obs["intrinsics.base_camera"][1].tolist() == [[2, 0, 3], [0, 2, 2], [0, 0, 1]]
    # the camera is 10 cm behind the TCP at (1, 2, 3) along its approach direction, column z of its rotation matrix
    approach = from_wxyz(np.array(POSE, np.float64))[:3, 2]
    np.testing.assert_allclose(obs["camera_in_base.base_camera"][1, :3, 3], [1, 2, 3] - 0.1 * approach, atol=1e-6)
    assert obs["images.base_camera_depth"].shape == (2, 1, 4, 6)
    assert env.step(act(0, 0, gripper=1.0))[0]["gripper_open"].tolist() == [[1.0], [1.0]]
    obs = env.step(act(1, 1))[0]
    assert obs["gripper_open"].tolist() == [[0.0], [0.0]]
    assert (obs["pixels"]["base_camera"] == 3).all() and (obs["images.base_camera_depth"] == 300).all()
    assert env.render()[0].shape == (4, 6, 3)
    assert info["is_success"].tolist() == [False, False] and "final_info" not in info


def test_env_returns_its_last_observation_after_the_end_of_its_episode(make):
    env = make()
    env.reset(seed=0)
    results = [env.step(act(2.5, 1)) for _ in range(5)]
    rewards = [result[1].tolist() for result in results]
    assert rewards == [[0, 0], [1, 0], [0, 0], [0, 0], [0, 1]]
    assert [result[2].tolist() for result in results][1:4] == [[True, False]] * 3
    assert not any(result[3].any() for result in results)
    pixels = [result[0]["pixels"]["base_camera"][:, 0, 0, 0].tolist() for result in results]
    assert pixels == [[2, 2], [3, 3], [3, 4], [3, 5], [3, 6]]
    infos = [result[4] for result in results]
    assert [info["is_success"].tolist() for info in infos] == [[False] * 2, *[[True, False]] * 3, [True, True]]
    assert [step for step, info in enumerate(infos) if "final_info" in info] == [1, 4]
    assert infos[1]["_final_info"].tolist() == [True, False]
    assert infos[4]["final_info"]["is_success"].tolist() == [True, True]
    after = env.step(act(9, 9))
    np.testing.assert_array_equal(after[0]["agent_pos"], results[-1][0]["agent_pos"])
    assert not after[1].any() and after[2].all()


def test_an_episode_without_success_is_truncated_and_one_with_an_error_terminated(make):
    env = make()
    env.reset(seed=0)
    assert env.call("_max_episode_steps") == (200, 200)
    broken = act(0, 0)
    broken[1] = np.inf
    _, _, terminated, truncated, _ = env.step(broken)
    assert (terminated.tolist(), truncated.tolist()) == ([False, True], [False, False])
    for _ in range(199):
        _, reward, terminated, truncated, info = env.step(act(0, 0))
    assert (terminated.tolist(), truncated.tolist()) == ([False, True], [True, False])
    assert not info["is_success"].any() and not reward.any()


def test_seeds_are_indices_of_the_tasks_episodes_modulo_their_number(make, made):
    env = make(task="search")
    env.reset(seed=1001)
    assert env.episodes.tolist() == [5, 4]
    said = [SMOKE.episodes[number].instruction for number in (5, 4)]
    assert list(env.call("task_description")) == list(env.get_attr("task_description")) == said
    assert env.get_attr("task") == ("search", "search")
    env.reset()
    assert env.episodes.tolist() == [5, 4]
    env.reset(seed=[0, 0])
    assert env.episodes.tolist() == [4, 4]
    assert len(made) == 1 and made[0].num_envs == 2
    with pytest.raises(ValueError, match="expected one integer, or one per env"):
        env.reset(seed=[1])
    with pytest.raises(ValueError, match="actions: expected"):
        env.step(np.zeros((2, 6)))
    with pytest.raises(AttributeError, match="task_description"):
        env.get_attr("nothing")


def test_outcomes_are_written_once_per_episode(make, tmp_path):
    env = make(1, out=tmp_path / "result")
    for _ in range(2):  # two passes over the two episodes
        for seed in (0, 1):
            env.reset(seed=seed)
            while not env.step(act(1))[2].all():
                pass
    env.close()
    result = read_result(tmp_path / "result")
    assert sorted(result.outcomes) == [0, 1] and result.run.policy.name == "mine"
    assert all((result.read_actions(number) == np.tile(act(1), (5, 1))).all() for number in (0, 1))
    for _ in range(2):  # a refused environment does not keep the lock
        with pytest.raises(EvaluationError, match="already has a result"):
            make(1, out=tmp_path / "result")


def test_the_folder_of_a_result_is_locked_until_the_environment_is_closed(make, tmp_path):
    first = make(1, out=tmp_path / "result")
    for refused in (lambda: make(1, out=tmp_path / "result"), lock_folder(tmp_path / "result").__enter__):
        with pytest.raises(RobocasError, match="another process writes to this folder"):
            refused()
    first.close()
    make(1, out=tmp_path / "result").reset(seed=0)


def test_several_envs_need_one_configuration(make):
    with pytest.raises(EvaluationError, match="one of the splits"):
        make(protocol="objects-v1")


@pytest.mark.slow
def test_real_episodes_have_the_outcomes_and_images_of_robocas_eval(needs_renderer, tmp_path):
    size, down = (48, 36), np.array([0, 0, 0.02, 0, 0, 0.1, 0.0], np.float32)
    spec = PolicySpec(reference="tcp", rate_hz=5, cameras={"gripper_camera": size})

    class Down:
        def __init__(self) -> None:
            self.spec, self.seen = spec, []

        def reset(self, episodes) -> None:
            pass

        def act(self, observations) -> np.ndarray:
            self.seen.append(observations.images["gripper_camera"][:, 0, 0].tolist())
            return np.tile(down, (len(observations.envs), 1))

    protocol, policy = str(shorten("smoke", tmp_path / "short", 5)), Down()
    settings = EvaluationSettings(("pick",), "down", protocol, tmp_path / "ours", workers=1, backend="processes")
    list(EvaluationSession(policy, settings).run())
    env = ProtocolVectorEnv(spec, replace(settings, out=tmp_path / "theirs"))
    obs, _ = env.reset(seed=2000)
    seen, done = [], np.zeros(2, bool)
    while not done.all():
        seen.append(obs["pixels"]["gripper_camera"][:, 0, 0].tolist())
        obs, _, terminated, truncated, _ = env.step(np.tile(down, (2, 1)))
        done = terminated | truncated
    env.close()
    assert seen == policy.seen and truncated.all()
    ours, theirs = (read_result(tmp_path / name).outcomes for name in ("ours", "theirs"))
    assert {n: one.reproducible_values() for n, one in ours.items()} == {
        n: one.reproducible_values() for n, one in theirs.items()
    }
    assert all(one.measures["path_length"] > 0.05 for one in theirs.values())
