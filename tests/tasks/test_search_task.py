"""The stage that search adds, and its scripted policy, in a small heap."""

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose

import robocas_ms3.tasks  # noqa: F401
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.tasks import occlusion
from robocas_ms3.tasks.search import MEASUREMENTS_PER_SECOND, PeriodicSchedule

pytestmark = pytest.mark.slow

CONFIG = "search_table_small_heap"
STATE_ONLY: dict[str, Any] = {"render_backend": "none", "control_mode": "pd_joint_pos", "obs_mode": "none"}


@pytest.fixture(scope="module")
def env():
    env = gym.make("RoboCASSearch-v1", config=CONFIG, **STATE_ONLY)
    yield env
    env.close()


def hold(env) -> bool:
    """Step until the heap has been looked at again, with the arm held still; give `obstacles_cleared`."""
    qpos = env.unwrapped.agent.robot.get_qpos()[0, 3:10].numpy()
    for _ in range(env.unwrapped.control_freq // MEASUREMENTS_PER_SECOND):
        *_, info = env.step(np.append(qpos, 1.0).astype(np.float32))
    return bool(info["obstacles_cleared"][0])


def take_away_the_others(base) -> None:
    for slot, actor in enumerate(base.objects):
        if slot != int(base.target_slot[0]):
            actor.set_pose(Pose.create_from_pq(torch.tensor([[-2.0, slot * 0.3 - 2.0, 0.1]]), actor.pose.q))


def covered_seed(env) -> int:
    """A seed whose target is not clear at the beginning."""
    for seed in range(20):
        _, info = env.reset(seed=seed)
        if not bool(info["obstacles_cleared"][0]):
            return seed
    raise AssertionError("every target is clear at once")


def test_the_target_of_a_heap_is_hidden_in_part(env):
    env.reset(seed=0)
    base = env.unwrapped
    layout = base.layout()
    assert layout.visible_fractions[layout.target] < base.task_config.target.max_visible_share
    found = base.clutter()
    assert found.hidden_fraction.shape == (1,)
    assert found.obstacles.shape == (1, 8)
    assert not bool(found.obstacles[0, layout.target])


def test_taking_the_others_away_clears_the_target_until_the_next_reset(env):
    seed = covered_seed(env)
    base = env.unwrapped
    before = base.get_state()
    assert not hold(env)
    take_away_the_others(base)
    assert hold(env)
    assert base.hidden_fraction.tolist() == [0]
    base.set_state(before)
    assert hold(env)  # sticky
    _, info = env.reset(seed=seed)
    assert not bool(info["obstacles_cleared"][0])


def test_the_heap_is_looked_at_five_times_a_second(env):
    env.reset(seed=covered_seed(env))
    base = env.unwrapped
    qpos = base.agent.robot.get_qpos()[0, 3:10].numpy()
    take_away_the_others(base)
    seen = []
    for _ in range(4):
        *_, info = env.step(np.append(qpos, 1.0).astype(np.float32))
        seen.append(bool(info["obstacles_cleared"][0]))
        assert not bool(info["cleared_at_reset"][0])
    assert seen == [False, False, False, True]


def test_a_target_that_lies_clear_from_the_beginning_is_told_from_one_that_was_cleared(env, monkeypatch):
    monkeypatch.setattr(occlusion.Clutter, "cleared", property(lambda found: found.hidden_fraction <= 1))
    _, info = env.reset(seed=0)
    assert bool(info["obstacles_cleared"][0])
    assert bool(info["cleared_at_reset"][0])
    *_, info = env.step(np.append(env.unwrapped.agent.robot.get_qpos()[0, 3:10].numpy(), 1.0).astype(np.float32))
    assert bool(info["cleared_at_reset"][0])
    monkeypatch.undo()
    _, info = env.reset(seed=covered_seed(env))
    assert not bool(info["cleared_at_reset"][0])


def test_a_restored_heap_is_looked_at_at_once(env):
    seed = covered_seed(env)
    base = env.unwrapped
    before, share = base.get_state_dict(), base.hidden_fraction.clone()
    take_away_the_others(base)
    assert hold(env)
    cleared = base.get_state_dict()
    base.set_state_dict(before)
    info = base.get_info()
    assert torch.equal(base.hidden_fraction, share)
    assert not bool(info["obstacles_cleared"][0])
    env.reset(seed=seed)
    base.set_state_dict(cleared)
    info = base.get_info()
    assert base.hidden_fraction.tolist() == [0]  # it is not looked at any more
    base.set_state_dict({**cleared, "task": {"stages": cleared["task"]["stages"]}})  # what is missing stays
    assert base.hidden_fraction.tolist() == [0]
    assert bool(info["obstacles_cleared"][0])
    assert not bool(info["cleared_at_reset"][0])


def test_a_target_that_was_pulled_out_or_fell_has_not_been_cleared(env):
    seed = covered_seed(env)
    base = env.unwrapped
    base.success_check.stages["target_grasped"][:] = True  # and let go of since
    take_away_the_others(base)
    assert not hold(env)
    env.reset(seed=seed)
    target = base.objects[int(base.target_slot[0])]
    target.set_pose(Pose.create_from_pq(torch.tensor([[-1.0, -1.0, 0.1]]), target.pose.q))
    assert not hold(env)


def test_the_policy_finds_the_target_and_says_what_it_moved(tmp_path):
    generator = EpisodeGenerator(EpisodeSettings("search", "search_table_small_heap", "builtin", max_attempts=6))
    try:
        result = next(r for s in (3, 4) if (r := generator.generate(s, tmp_path, f"episode_{s}")).success)
    finally:
        generator.close()
    episode = json.loads((tmp_path / f"episode_{result.seed}.json").read_text())
    record = episode["episodes"][0]["robocas"]
    assert record["facts"]["pushes"] + record["facts"]["removals"] >= 1
    kinds = [part["goal_type"] for part in record["subgoals"]]
    assert kinds[0] == "find the object"
    assert kinds[-2:] == ["move and grasp", "transfer object"]
    assert result.steps < 2400


def test_envs_are_due_before_their_first_step_and_every_period_after():
    schedule = PeriodicSchedule(4, 3, "cpu")
    found = []
    for step in range(10):
        if step == 4:
            schedule.reset(np.array([1, 2]))
        if step == 8:
            schedule.every_step(np.array([3]))
        found.append(schedule.due().tolist())
        schedule.advance()
    assert found == [[0, 1, 2, 3], [], [], [0, 1, 2, 3], [1, 2], [], [0, 3], [1, 2], [3], [0, 3]]
    schedule.reset(np.array([3]))
    schedule.advance()
    assert schedule.due().tolist() == []
