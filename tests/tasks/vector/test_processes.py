"""Results, errors and ends of worker processes."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing

import numpy as np
import pytest
import torch
from vector_envs import (
    HORIZON,
    CrashingWrapper,
    CustomError,
    MisbehavingWrapper,
    MissingLayoutsWrapper,
    SucceedingWrapper,
    make_actions,
    make_short_vec,
    wait_for_end,
)

from robocas_ms3.core.errors import ConfigError, ExtensionError, LayoutError, VectorEnvCrashError, VectorEnvError
from robocas_ms3.core.workers import Limits
from robocas_ms3.tasks import RoboCASPickEnv

slow = pytest.mark.slow


@pytest.fixture(scope="module")
def env():
    with closing(
        make_short_vec(3, 2, arrays="numpy", obs_mode="state_dict", reward_mode="dense", wrappers=[SucceedingWrapper])
    ) as made:
        yield made


@slow
def test_infos_observations_and_metrics_in_numpy(env):
    obs, info = env.reset(seed=0)
    assert info["reconfigure"] is True
    assert obs["agent"]["qpos"].shape == env.observation_space["agent"]["qpos"].shape == (3, 12)
    env.step(make_actions(1, 0, 1))
    _, reward, terminated, truncated, info = env.step(make_actions(1, 0, 1))
    assert (reward.tolist(), reward.dtype) == ([1, 0, 1], np.float32)
    assert terminated.tolist() == info["_final_info"].tolist() == [True, False, True]
    assert info["elapsed_steps"].tolist() == [0, 2, 0]
    final = info["final_info"]
    assert final["note"] == ["step 2"] * 3
    assert final["more"].tolist() == [[1, 1]] * 3
    assert [type(some) for some in final["of_some"]] == [np.ndarray, type(None), np.ndarray]
    assert final["episode"]["success_once"].tolist() == [True, False, True]
    assert info["final_obs"]["agent"]["qpos"].shape == (3, 12)
    for _ in range(2):
        *_, truncated, info = env.step(make_actions(0, 0, 0))
    assert truncated.tolist() == [False, True, False]
    assert info["final_info"]["episode"]["success_at_end"].tolist() == [False, False, False]
    assert env.unwrapped.call("control_freq") == (20, 20, 20)
    layouts = env.unwrapped.call_each("layout", {2: (0,), 0: ()})
    assert sorted(layouts) == [0, 2]
    assert len({len(one["actors"]) for one in env.unwrapped.call("get_state_dict")}) == 1


@slow
def test_terms_of_the_reward_are_batched(env):
    env.reset(seed=0)
    *_, info = env.step(make_actions(0, 1, 0))
    *_, last = [env.step(make_actions(0, 1, 0)) for _ in range(HORIZON - 1)][-1]
    for terms in (info["reward_terms"], last["final_info"]["reward_terms"]):
        assert {(type(term), term.shape, term.dtype.kind) for term in terms.values()} == {(np.ndarray, (3,), "f")}
    assert not np.array_equal(*([terms[i] for terms in info["reward_terms"].values()] for i in (0, 1)))


@slow
def test_requested_seed_without_layout_is_an_error():
    with closing(make_short_vec(2, 1, wrappers=[MissingLayoutsWrapper], seeds=(4, 6))) as env:
        with pytest.raises(LayoutError, match="no object qualifies"):
            env.reset(seed=5)
        with pytest.raises(VectorEnvError, match="envs 0, 1.*failed.*Reset"):
            env.step(make_actions(0, 0))
        drawn, _ = env.reset(seed=4)  # 4, and for env 1 another than 5
        with pytest.raises(LayoutError):
            env.reset(seed=[4, 5])
        assert torch.equal(drawn, env.reset(seed=4)[0])
        assert torch.equal(drawn[0], env.reset(seed=6)[0][1])  # after the last seed of the range comes its first
        with pytest.raises(LayoutError, match="none was drawn"):  # an unseeded reset of env 1 is that of a single env
            env.reset(options={"draws_none_after": 4})


@slow
def test_errors_and_crashes_of_a_process(capfd):
    with closing(make_short_vec(4, 2, wrappers=[MisbehavingWrapper])) as env:
        first, _ = env.reset(seed=0)
        with pytest.raises(CustomError) as error:
            env.step(make_actions(0, 0, 2, 3))
        assert error.value.args == ("gripper fell off", 7)
        assert "env 2" in str(error.value.__cause__)
        assert "in step\n    raise CustomError" in str(error.value.__cause__)
        with pytest.raises(VectorEnvError, match="Reset these environments"):
            env.step(make_actions(0, 0, 0, 0))
        assert torch.equal(env.reset(seed=0)[0], first)
        with pytest.raises(RuntimeError, match="UnpicklableError: lost somewhere"):
            env.step(make_actions(3, 0, 0, 0))
        env.reset(seed=0)
        with pytest.raises(TypeError, match="pickle.*lock"):
            env.step(make_actions(0, 6, 0, 0))
        env.reset(seed=0)
        with pytest.raises(ExtensionError, match="env 1: this code tried to end the process"):
            env.step(make_actions(0, 8, 0, 0))
        # interrupted in the middle of a step
        env.reset(seed=0)
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            env.step(make_actions(5, 0, 0, 0))
        with pytest.raises(VectorEnvError, match="interrupted"):
            env.step(make_actions(0, 0, 0, 0))
        assert torch.equal(env.reset(seed=0)[0], first)
        plain = env.step(make_actions(1, 1, 1, 1))[0]
        env.reset(seed=0)
        assert torch.equal(env.step(make_actions(1, 1, 1, 1))[0], plain)
        # a fork of this process does not end the workers
        child = os.fork()
        if not child:
            env.close()
            os._exit(0)
        os.waitpid(child, 0)
        env.step(make_actions(1, 1, 1, 1))
        # killed
        pids = env.unwrapped.pids
        with pytest.raises(VectorEnvCrashError, match=r"env 3: its worker process crashed \(found SIGKILL"):
            env.step(make_actions(7, 0, 0, 4))  # without waiting for the first one
        assert wait_for_end(pids)
        with pytest.raises(VectorEnvError, match="closed"):
            env.step(make_actions(0, 0, 0, 0))
        env.close()
    env.close()
    assert "Traceback" not in capfd.readouterr().err


@slow
def test_process_killed_between_two_steps_is_not_replaced():
    with closing(make_short_vec(2, 2)) as env:
        env.reset(seed=0)
        pids = env.unwrapped.pids
        os.kill(pids[1], signal.SIGKILL)
        with pytest.raises(VectorEnvCrashError, match="env 1: its worker process crashed") as died:
            env.step(make_actions(0, 0))
        assert died.value.envs == (1,)
        assert wait_for_end(pids)


@slow
@pytest.mark.parametrize(
    ("limits", "found"), [(Limits(seconds=5), "time limit exceeded"), (Limits(memory_gb=0.3), "memory limit exceeded")]
)
def test_a_process_that_exceeds_a_limit_is_ended(limits, found):
    raises = pytest.raises(VectorEnvCrashError, match="env 0")
    with raises as died, closing(make_short_vec(1, 1, wrappers=[MisbehavingWrapper], limits=limits)) as env:
        env.reset(seed=0)
        env.step(make_actions(7))
    assert died.value.found == found


@slow
def test_close_does_not_wait_for_a_busy_process():
    env = make_short_vec(1, 1, wrappers=[MisbehavingWrapper])
    env.reset(seed=0)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        env.step(make_actions(5))
    started, pids = time.monotonic(), env.unwrapped.pids
    env.close()
    assert time.monotonic() - started < 2.5
    assert wait_for_end(pids)


@slow
def test_errors_of_making_environments_keep_their_type():
    with pytest.raises(ConfigError, match="no_such_config") as error:
        make_short_vec(2, 1, config="no_such_config")
    assert "env 0" in str(error.value.__cause__)
    with pytest.raises(VectorEnvError, match="can't be sent"):
        make_short_vec(1, 1, config={"lock": threading.Lock()})
    with pytest.raises(VectorEnvCrashError) as died:
        make_short_vec(1, 1, wrappers=[CrashingWrapper])
    assert died.value.envs == (0,)
    assert died.value.found == "SIGSEGV" and "robocas doctor" in died.value.fix


def test_env_registered_in_the_main_program_is_an_error(monkeypatch):
    monkeypatch.setattr(RoboCASPickEnv, "__module__", "__main__")
    with pytest.raises(VectorEnvError, match=r"RoboCASPick-v1.*my_module:"):
        make_short_vec(1, 1)


@slow
def test_deleted_vector_environment_is_closed():
    env = make_short_vec(1, 1)
    pids = env.unwrapped.pids
    del env
    gc.collect()
    assert wait_for_end(pids)


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
    assert wait_for_end([int(pid) for pid in done.stdout.split()])
    assert len(done.stdout.split()) == 1
    assert done.stderr.count("Traceback") == ("SIGINT" in end)
