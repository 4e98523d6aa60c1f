"""Keyword arguments for training: expected values, and use by the environments."""

import gymnasium as gym
import numpy as np
import pytest

import robocas_ms3
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.tasks import TASKS

HORIZONS = {
    ("pick", None): 100,
    ("pick", "pick_shelf_orderly"): 100,
    ("select", None): 100,
    ("search", None): 450,
    ("open_pick", None): 200,
    ("open_pick", "open_pick_drawer"): 200,
    ("open_pick", "open_pick_cabinet_door"): 350,
    ("open_pick", "open_pick_refrigerator"): 350,
}


@pytest.mark.parametrize(("task", "config"), HORIZONS)
def test_horizons_fit_the_configuration(task, config):
    kwargs = robocas_ms3.rl_kwargs(task, config)
    assert kwargs["max_episode_steps"] == HORIZONS[task, config]
    assert kwargs.get("config") == config
    assert robocas_ms3.rl_kwargs(TASKS[task].env_id, config) == kwargs


def test_all_keyword_arguments():
    assert robocas_ms3.rl_kwargs("pick") == {
        "obs_mode": "state",
        "reward_mode": "normalized_dense",
        "control_mode": "pd_ee_delta_pose",
        "sim_config": {"control_freq": 5},
        "max_episode_steps": 100,
        "render_backend": "none",
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("RoboCASPick-v2",), r"no such task .*pick or RoboCASPick-v1, .*found 'RoboCASPick-v2'"),
        (("pick", "pick_tabel_scattered"), "no such task configuration.*pick_table_scattered"),
        (("pick", "search_table_stacked"), r"RoboCASPick-v1 can't run the configuration search_table_stacked"),
    ],
)
def test_unknown_tasks_and_configurations_are_errors(arguments, message):
    with pytest.raises(ConfigError, match=message):
        robocas_ms3.rl_kwargs(*arguments)


@pytest.mark.parametrize(
    ("task", "config", "numbers"),
    [("pick", None, 7), ("open_pick", "open_pick_refrigerator", 10)],
)
def test_environments_accept_the_arguments_and_stop_at_the_horizon(task, config, numbers):
    kwargs = robocas_ms3.rl_kwargs(task, config)
    env = gym.make(TASKS[task].env_id, **kwargs | {"max_episode_steps": 2})
    env.reset(seed=0)
    assert env.unwrapped.control_freq == 5
    assert env.action_space.shape == (numbers,)
    ends = [bool(env.step(np.zeros(numbers, np.float32))[3]) for _ in range(2)]
    assert ends == [False, True]
    env.close()
