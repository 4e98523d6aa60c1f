"""What envs in processes tell: observations, infos and metrics, batched."""

from contextlib import closing

import numpy as np
import pytest
from vector_envs import HORIZON, doing, make
from vector_wrappers import Narrow, Wins

from robocas_ms3.core.errors import VectorEnvError

slow = pytest.mark.slow


@pytest.fixture(scope="module")
def env():
    with closing(make(3, 2, arrays="numpy", obs_mode="state_dict", reward_mode="dense", wrappers=[Wins])) as made:
        yield made


@slow
def test_infos_observations_and_metrics_in_numpy(env):
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
    assert info["final_obs"]["agent"]["qpos"].shape == (3, 12)
    for _ in range(2):
        *_, truncated, info = env.step(doing(0, 0, 0))
    assert truncated.tolist() == [False, True, False]
    assert info["final_info"]["episode"]["success_at_end"].tolist() == [False, False, False]
    assert env.unwrapped.call("control_freq") == (20, 20, 20)
    assert len({len(one["actors"]) for one in env.unwrapped.call("get_state_dict")}) == 1


@slow
def test_terms_of_the_reward_are_batched(env):
    env.reset(seed=0)
    *_, info = env.step(doing(0, 1, 0))
    *_, last = [env.step(doing(0, 1, 0)) for _ in range(HORIZON - 1)][-1]
    for terms in (info["reward_terms"], last["final_info"]["reward_terms"]):
        assert {(type(term), term.shape, term.dtype.kind) for term in terms.values()} == {(np.ndarray, (3,), "f")}
    assert not np.array_equal(*([terms[i] for terms in info["reward_terms"].values()] for i in (0, 1)))


@slow
def test_observations_of_another_shape_need_a_space():
    words = r"obs.*expected \(1, \d\d+\), found \(1, 1\).*single_observation_space"
    with closing(make(1, 1, wrappers=[Narrow])) as env, pytest.raises(VectorEnvError, match=words):
        env.reset(seed=0)
