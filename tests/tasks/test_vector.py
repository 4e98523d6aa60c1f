"""Several environments at once: which backend, ManiSkill's conventions, and that an env's episodes are its own."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
import torch
from vector_wrappers import LacksLayouts, Misbehaves, Narrow, OwnError, Wins

import robocas_ms3
from robocas_ms3.errors import ConfigError, LayoutError, VectorEnvError, WorkerDied
from robocas_ms3.tasks import RoboCASPickEnv, vector
from robocas_ms3.tasks.vector.backend import choose_backend
from robocas_ms3.tasks.vector.environment import RoboCASVectorEnv

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_delta_pos", "obs_mode": "state"}
HORIZON = 4
slow = pytest.mark.slow


def with_gpu(monkeypatch, there: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)


# ------------------------------------------------------------------ what is asked for


@pytest.mark.parametrize(
    ("backend", "sim_backend", "gpu", "chosen"),
    [
        ("auto", "auto", True, "gpu"),
        ("auto", "auto", False, "processes"),
        ("auto", "cpu", True, "processes"),
        ("auto", "physx_cuda", True, "gpu"),
        ("processes", "auto", True, "processes"),
        ("gpu", "cuda:1", True, "gpu"),
    ],
)
def test_the_backend_follows_from_what_is_asked_and_what_is_there(monkeypatch, backend, sim_backend, gpu, chosen):
    with_gpu(monkeypatch, gpu)
    assert choose_backend(backend, sim_backend) == chosen


@pytest.mark.parametrize(
    ("backend", "sim_backend", "gpu", "words"),
    [
        ("gpu", "auto", False, ["no CUDA device", 'backend="processes"']),
        ("auto", "physx_cuda", False, ["no CUDA device"]),
        ("gpu", "physx_cpu", True, ["contradict", "physx_cpu"]),
        ("processes", "physx_cuda", True, ["contradict", "physx_cuda"]),
        ("threads", "auto", True, ["threads", "processes"]),
    ],
)
def test_a_backend_that_can_not_be_is_an_error(monkeypatch, backend, sim_backend, gpu, words):
    with_gpu(monkeypatch, gpu)
    with pytest.raises(VectorEnvError) as error:
        choose_backend(backend, sim_backend)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"env_id": "RoboCASPik-v1"}, ["RoboCASPik-v1", "RoboCASPick-v1"]),
        ({"env_id": "nowhere_at_all:RoboCASPick-v1"}, ["nowhere_at_all"]),
        ({"env_id": "CartPole-v1"}, ["CartPole-v1", "RoboCASPick-v1"]),
        ({"num_envs": 0}, ["num_envs", "from 1 on", "0"]),
        ({"num_envs": 2.0}, ["num_envs", "2.0"]),
        ({"workers": 0}, ["workers"]),
        ({"arrays": "jax"}, ["jax", "numpy"]),
    ],
)
def test_wrong_arguments_are_one_line(arguments, words):
    with pytest.raises(VectorEnvError) as error:
        robocas_ms3.make_vec(**{"env_id": "RoboCASPick-v1", "num_envs": 2, **arguments}, **STATE_ONLY)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize("arguments", [{}, {"sim_backend": "physx_cpu"}])
def test_several_envs_in_one_process_on_a_cpu_point_to_make_vec(monkeypatch, arguments):
    with_gpu(monkeypatch, bool(arguments))
    with pytest.raises(VectorEnvError, match=r"num_envs=4.*robocas_ms3\.make_vec"):
        gym.make("RoboCASPick-v1", num_envs=4, **STATE_ONLY, **arguments)


# ------------------------------------------------------------------ one batch


class FakeBatch(gym.Env):
    """Three envs that count their steps: env i succeeds at step i + 2 alone, and every fourth step is the last."""

    reconfiguration_freq, device, spec = 0, torch.device("cpu"), None
    single_action_space = gym.spaces.Box(-1, 1, (2,))
    single_observation_space = gym.spaces.Box(0, 9, (1,))
    action_space, observation_space = gym.spaces.Box(-1, 1, (3, 2)), gym.spaces.Box(0, 9, (3, 1))

    def __init__(self, **kwargs) -> None:
        self.metadata, self.kwargs, self.num_envs = {}, kwargs, kwargs.get("num_envs", 3)
        self.elapsed_steps = torch.zeros(3, dtype=torch.int32)

    def reset(self, *, seed=None, options=None):
        self.elapsed_steps[options["env_idx"] if options else slice(None)] = 0
        return self.elapsed_steps[:, None].float(), {"elapsed_steps": self.elapsed_steps.clone()}

    def step(self, action):
        self.elapsed_steps += 1
        won = self.elapsed_steps == torch.arange(3) + 2
        info = {"success": won, "elapsed_steps": self.elapsed_steps.clone()}
        ended = self.elapsed_steps >= 4
        return self.elapsed_steps[:, None].float(), won.float(), won.clone(), ended, info


def test_success_once_and_at_end_of_an_episode():
    env = RoboCASVectorEnv(FakeBatch(), ignore_terminations=True, record_metrics=True)
    env.reset()
    for _ in range(3):
        *_, info = env.step(None)
        assert "final_info" not in info
    assert info["episode"]["success_at_end"].tolist() == [False, True, False]
    obs, _, terminated, truncated, info = env.step(None)
    episode = info["final_info"]["episode"]
    assert episode["success_once"].tolist() == [True, True, True]
    assert episode["success_at_end"].tolist() == [False, False, True]
    assert (obs.tolist(), info["final_observation"].tolist()) == ([[0.0]] * 3, [[4.0]] * 3)
    assert not terminated.any() and truncated.all()


def test_an_episode_that_ends_with_success_succeeded_at_its_end():
    env = RoboCASVectorEnv(FakeBatch(), record_metrics=True)
    env.reset()
    env.step(None)
    *_, info = env.step(None)
    assert info["_final_info"].tolist() == [True, False, False]
    assert info["final_info"]["episode"]["success_at_end"].tolist() == [True, False, False]


def test_calls_reach_through_wrappers():
    env = RoboCASVectorEnv(gym.Wrapper(FakeBatch()))
    env.reset()
    assert env.call("elapsed_steps").tolist() == [0, 0, 0]
    assert len(env.call("step", None)) == 5


def test_a_gpu_gets_the_same_arguments_in_one_batch(monkeypatch):
    with_gpu(monkeypatch, True)
    monkeypatch.setattr(vector.gym, "make", lambda env_id, **kwargs: FakeBatch(env_id=env_id, **kwargs))
    wrapped = []
    env = robocas_ms3.make_vec("RoboCASPick-v1", 3, wrappers=[lambda env: wrapped.append(env) or env], **STATE_ONLY)
    expected = {"env_id": "RoboCASPick-v1", "num_envs": 3, "sim_backend": "physx_cuda", **STATE_ONLY}
    assert env.unwrapped.kwargs == expected
    assert wrapped == [env.unwrapped]
    assert (env.auto_reset, env.ignore_terminations, env.record_metrics) == (True, False, True)
    assert env.metadata["autoreset_mode"] == gym.vector.AutoresetMode.SAME_STEP
    env = robocas_ms3.make_vec("RoboCASPick-v1", 3, sim_backend="cuda:1", arrays="numpy", **STATE_ONLY)
    assert env.unwrapped.kwargs["sim_backend"] == "cuda:1"
    env.reset()
    obs, reward, terminated, truncated, info = env.step(None)
    for array in (obs, reward, terminated, truncated, info["episode"]["success_once"]):
        assert isinstance(array, np.ndarray)


# ------------------------------------------------------------------ processes


def make(num_envs: int, workers: int, **kwargs):
    kwargs = {"backend": "processes", "max_episode_steps": HORIZON, **STATE_ONLY, **kwargs}
    return robocas_ms3.make_vec("RoboCASPick-v1", num_envs, workers=workers, **kwargs)


def doing(*what: int) -> np.ndarray:
    """Actions that begin with these numbers, one an env."""
    actions = np.zeros((len(what), 8), np.float32)
    actions[:, 0] = what
    return actions


def gone(pids: list[int]) -> bool:
    """Whether processes end within 5 s, and leave nothing."""
    for _ in range(100):
        if not any(os.path.exists(f"/proc/{pid}") for pid in pids):
            return True
        time.sleep(0.05)
    return False


def actions_of(seed: int, steps: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 8)).astype(np.float32)


def episodes(env, num_envs: int, first_seed: int, steps: int) -> list[list[bytes]]:
    """What each env observes at its reset and each of its steps, over the ends of episodes, and its instruction."""
    actions = np.stack([actions_of(first_seed + i, steps) for i in range(num_envs)], 1)
    obs, _ = env.reset(seed=first_seed)
    seen = [[row.numpy().tobytes()] for row in obs]
    for action in actions:
        obs, *_, info = env.step(action)
        for i, row in enumerate(obs):
            last = info["final_observation"][i] if "final_info" in info and info["_final_info"][i] else row
            seen[i] += [last.numpy().tobytes(), row.numpy().tobytes()]
    for i, said in enumerate(env.unwrapped.get_language_instruction()):
        seen[i].append(said.encode())
    return seen


@pytest.fixture(scope="module")
def four():
    env = make(4, 2)
    yield env
    env.close()


@slow
def test_an_env_is_the_same_whatever_the_others_are(four):
    steps = 2 * HORIZON + 2
    seen = episodes(four, 4, 10, steps)
    with closing(make(2, 2)) as two, closing(make(1, 1)) as one:
        unseeded = two.reset()[0]
        assert torch.equal(one.reset()[0], unseeded[:1])
        assert not torch.equal(unseeded[1], unseeded[0])
        assert episodes(two, 2, 10, steps) == seen[:2]
        assert episodes(one, 1, 12, steps) == seen[2:3]
    with closing(make(4, 1)) as in_one_process:
        assert episodes(in_one_process, 4, 10, steps) == seen
    assert len({b"".join(env) for env in seen}) == 4


@slow
def test_an_env_is_what_gym_makes(four):
    steps = HORIZON + 2
    seen = episodes(four, 4, 20, steps)[3]
    env = gym.make("RoboCASPick-v1", max_episode_steps=HORIZON, **STATE_ONLY)
    obs, _ = env.reset(seed=23)
    plain = [obs[0].numpy().tobytes()]
    for action in actions_of(23, steps):
        obs, _, _, truncated, _ = env.step(action)
        plain.append(obs[0].numpy().tobytes())
        if truncated:
            obs, _ = env.reset()
        plain.append(obs[0].numpy().tobytes())
    assert [*plain, env.unwrapped.get_language_instruction()[0].encode()] == seen
    env.close()


@slow
def test_some_envs_are_reset_and_the_others_stay_as_they_are(four):
    first, _ = four.reset(seed=[50, 51, 52, 53])
    once, *_ = four.step(doing(1, 1, 1, 1))
    twice, *_ = four.step(doing(1, 1, 1, 1))
    obs, info = four.reset(seed=[50], options={"env_idx": torch.tensor([2])})
    assert info["elapsed_steps"].tolist() == [2, 2, 0, 2]
    assert torch.equal(obs[[0, 1, 3]], twice[[0, 1, 3]])
    assert torch.equal(obs[2], first[0])
    obs, *_ = four.step(doing(1, 1, 1, 1))
    assert torch.equal(obs[2], once[0])
    four.reset(seed=[50, 51, 52, 53])
    for _ in range(3):
        undisturbed, *_ = four.step(doing(1, 1, 1, 1))
    assert torch.equal(obs[[0, 1, 3]], undisturbed[[0, 1, 3]])
    assert torch.equal(four.reset(seed=50, options={"env_idx": [3, 1]})[0][3], first[0])  # 50 for env 3, 51 for env 1
    assert torch.equal(four.reset(options={"env_idx": np.array([False] * 4)})[0][1], first[1])
    for wrong in ({"env_idx": [0, 4]}, {"env_idx": [1, 1]}, {"env_idx": 1}):
        with pytest.raises(VectorEnvError, match="env_idx"):
            four.reset(options=wrong)
    with pytest.raises(VectorEnvError, match="expected 4.*found 2"):
        four.reset(seed=[1, 2])
    with pytest.raises(VectorEnvError, match=r"\(4, 8\).*\(4, 7\)"):
        four.step(np.zeros((4, 7)))


@slow
def test_infos_observations_and_metrics_in_numpy():
    env = make(3, 2, arrays="numpy", obs_mode="state_dict", wrappers=[Wins])
    with closing(env):
        obs, info = env.reset(seed=0)
        assert info["reconfigure"] is True
        assert obs["agent"]["qpos"].shape == env.observation_space["agent"]["qpos"].shape == (3, 12)
        env.step(doing(1, 0, 1))
        _, reward, terminated, truncated, info = env.step(doing(1, 0, 1))
        assert (reward.tolist(), reward.dtype) == ([1, 0, 1], np.float32)
        assert terminated.tolist() == info["_final_info"].tolist() == [True, False, True]
        assert info["elapsed_steps"].tolist() == [0, 2, 0]
        final = info["final_info"]
        assert final["note"] == ["step 2"] * 3
        assert final["more"].tolist() == [[1, 1]] * 3
        assert [type(some) for some in final["of_some"]] == [np.ndarray, type(None), np.ndarray]
        assert final["episode"]["success_once"].tolist() == [True, False, True]
        assert info["final_observation"]["agent"]["qpos"].shape == (3, 12)
        for _ in range(2):
            *_, truncated, info = env.step(doing(0, 0, 0))
        assert truncated.tolist() == [False, True, False]
        assert info["final_info"]["episode"]["success_at_end"].tolist() == [False, False, False]
        assert env.unwrapped.call("control_freq") == (20, 20, 20)
        assert len({len(one["actors"]) for one in env.unwrapped.call("get_state_dict")}) == 1


@slow
def test_terms_of_the_reward_are_batched():
    with closing(make(3, 2, reward_mode="dense", arrays="numpy")) as env:
        env.reset(seed=0)
        *_, info = env.step(doing(0, 1, 0))
        *_, last = [env.step(doing(0, 1, 0)) for _ in range(HORIZON - 1)][-1]
        for terms in (info["reward_terms"], last["final_info"]["reward_terms"]):
            assert {(type(term), term.shape, term.dtype.kind) for term in terms.values()} == {(np.ndarray, (3,), "f")}
        assert not np.array_equal(*([terms[i] for terms in info["reward_terms"].values()] for i in (0, 1)))


@slow
def test_a_seed_without_a_layout_is_an_error_where_it_was_asked_for():
    with closing(make(2, 1, wrappers=[LacksLayouts], seeds=(4, 6))) as env:
        with pytest.raises(LayoutError, match="no object qualifies"):
            env.reset(seed=5)
        with pytest.raises(VectorEnvError, match="envs 0, 1.*failed.*Reset"):
            env.step(doing(0, 0))
        drawn, _ = env.reset(seed=4)  # 4, and for env 1 another than 5
        with pytest.raises(LayoutError):
            env.reset(seed=[4, 5])
        assert torch.equal(drawn, env.reset(seed=4)[0])
        assert torch.equal(drawn[0], env.reset(seed=6)[0][1])  # after the last seed of the range comes its first
        with pytest.raises(LayoutError, match="none was drawn"):  # without a seed env 1 does what it does alone
            env.reset(options={"draws_none_after": 4})


@slow
def test_what_goes_wrong_in_a_process(capfd):
    with closing(make(4, 2, wrappers=[Misbehaves])) as env:
        begun, _ = env.reset(seed=0)
        with pytest.raises(OwnError) as error:
            env.step(doing(0, 0, 2, 3))
        assert error.value.args == ("gripper fell off", 7)
        assert "env 2" in str(error.value.__cause__)
        assert "in step\n    raise OwnError" in str(error.value.__cause__)
        with pytest.raises(VectorEnvError, match="Reset them first"):
            env.step(doing(0, 0, 0, 0))
        assert torch.equal(env.reset(seed=0)[0], begun)
        with pytest.raises(VectorEnvError, match="Unsendable: lost somewhere"):
            env.step(doing(3, 0, 0, 0))
        env.reset(seed=0)
        with pytest.raises(TypeError, match="pickle.*lock") as error:
            env.step(doing(0, 6, 0, 0))
        assert "env 1" in str(error.value.__cause__)
        # interrupted in the middle of a step
        env.reset(seed=0)
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            env.step(doing(5, 0, 0, 0))
        with pytest.raises(VectorEnvError, match="interrupted"):
            env.step(doing(0, 0, 0, 0))
        assert torch.equal(env.reset(seed=0)[0], begun)
        plain = env.step(doing(1, 1, 1, 1))[0]
        env.reset(seed=0)
        assert torch.equal(env.step(doing(1, 1, 1, 1))[0], plain)
        # a fork of this process has no say
        child = os.fork()
        if not child:
            env.close()
            os._exit(0)
        os.waitpid(child, 0)
        env.step(doing(1, 1, 1, 1))
        # killed
        pids = env.unwrapped.pids
        with pytest.raises(WorkerDied, match=r"env 3: its process died \(found SIGKILL"):
            env.step(doing(0, 0, 0, 4))
        assert gone(pids)
        with pytest.raises(VectorEnvError, match="closed"):
            env.step(doing(0, 0, 0, 0))
        env.close()
    env.close()
    assert "Traceback" not in capfd.readouterr().err


@slow
def test_observations_of_another_shape_need_a_space():
    words = r"obs.*expected \(1, \d\d+\), found \(1, 1\).*single_observation_space"
    with closing(make(1, 1, wrappers=[Narrow])) as env, pytest.raises(VectorEnvError, match=words):
        env.reset(seed=0)


@slow
def test_a_busy_process_is_not_waited_for():
    env = make(1, 1, wrappers=[Misbehaves])
    env.reset(seed=0)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        env.step(doing(5))
    begun, pids = time.monotonic(), env.unwrapped.pids
    env.close()
    assert time.monotonic() - begun < 2.5
    assert gone(pids)


@slow
def test_gymnasium_makes_the_same():
    one = gym.make("RoboCASPick-v1", **STATE_ONLY)  # its own time limit stays
    assert "TimeLimitWrapper" in str(one)
    one.close()
    kwargs = {"max_episode_steps": 1, "reconfiguration_freq": 0, **STATE_ONLY}
    with closing(gym.make_vec("RoboCASPick-v1", 2, backend="processes", workers=1, **kwargs)) as env:
        assert isinstance(env, RoboCASVectorEnv)
        assert len({int(seed[0]) for seed in env.call("_objects_seeds")}) == 2  # each is built with its own seed
        assert env.num_envs == 2
        env.reset(seed=0)
        *_, truncated, _ = env.step(doing(0, 0))
        assert truncated.tolist() == [True, True]


@slow
def test_envs_that_keep_their_objects_have_those_that_gym_makes():
    kwargs = {"reconfiguration_freq": 0, "seeds": (100, 199), **STATE_ONLY}
    plain = gym.make("RoboCASPick-v1", **kwargs)
    with closing(robocas_ms3.make_vec("RoboCASPick-v1", 2, backend="processes", workers=1, **kwargs)) as env:
        unseeded, seeded = env.reset()[0], env.reset(seed=[5, 5])[0]
        assert [int(seed[0]) for seed in env.call("_objects_seeds")] == [122, 123]  # 2022 and 2023, within the range
    assert torch.equal(unseeded[0], plain.reset()[0][0])
    assert torch.equal(seeded[0], plain.reset(seed=5)[0][0])
    plain.reset(seed=123, options={"reconfigure": True})
    assert torch.equal(seeded[1], plain.reset(seed=5)[0][0])
    plain.close()


@slow
def test_errors_of_making_arrive_as_themselves():

    with pytest.raises(ConfigError, match="no_such_config") as error:
        make(2, 2, config="no_such_config")
    assert "env 0" in str(error.value.__cause__)
    with pytest.raises(VectorEnvError, match="can't be sent"):
        make(1, 1, config={"lock": threading.Lock()})


def test_an_env_of_the_program_itself_can_not_be_sent(monkeypatch):
    monkeypatch.setattr(RoboCASPickEnv, "__module__", "__main__")
    with pytest.raises(VectorEnvError, match=r"RoboCASPick-v1.*the_module:"):
        make(1, 1)


@slow
def test_what_is_forgotten_is_closed():
    env = make(1, 1)
    pids = env.unwrapped.pids
    del env
    gc.collect()
    assert gone(pids)


PROGRAM = """
import os, signal, sys, gymnasium
import robocas_ms3

class Own(gymnasium.Wrapper):
    pass

env = robocas_ms3.make_vec("RoboCASPick-v1", backend="processes", wrappers=[Own, lambda env: env],
                           render_backend="none", obs_mode="none")
env.reset(seed=0)
print(*env.unwrapped.pids, flush=True)
"""


@slow
@pytest.mark.parametrize("end", ["", "os.kill(os.getpid(), signal.SIGKILL)", "os.kill(os.getpid(), signal.SIGINT)"])
def test_processes_end_with_a_program_that_was_read_from_a_pipe(end):
    done = subprocess.run([sys.executable, "-"], input=PROGRAM + end, capture_output=True, text=True, check=False)
    assert done.returncode == (-signal.SIGKILL if "SIGKILL" in end else -signal.SIGINT if end else 0), done.stderr
    assert gone([int(pid) for pid in done.stdout.split()])
    assert len(done.stdout.split()) == 1
    assert done.stderr.count("Traceback") == ("SIGINT" in end)


@slow
def test_pictures(needs_renderer):
    small = {"obs_mode": "rgb", "render_backend": "cpu", "sensor_configs": {"width": 32, "height": 24}}
    with closing(make(2, 1, **small)) as env:
        obs, _ = env.reset(seed=0)
        picture = obs["sensor_data"]["static_camera"]["rgb"]
        assert (picture.shape, picture.dtype) == ((2, 24, 32, 3), torch.uint8)
        plain = gym.make("RoboCASPick-v1", **{**STATE_ONLY, **small})
        for seed in (0, 1):
            alone = plain.reset(seed=seed)[0]["sensor_data"]["static_camera"]["rgb"][0]
            assert torch.equal(picture[seed], alone)
        plain.close()
