"""The stage ``obstacles_cleared`` and the scripted policy of search, in a small heap."""

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


def hold_until_measured(env) -> bool:
    """Hold the arm until the clutter has been measured again; return the stage ``obstacles_cleared``."""
    qpos = env.unwrapped.agent.robot.get_qpos()[0, 3:10].numpy()
    for _ in range(env.unwrapped.control_freq // MEASUREMENTS_PER_SECOND):
        *_, info = env.step(np.append(qpos, 1.0).astype(np.float32))
    return bool(info["obstacles_cleared"][0])


def remove_other_objects(base) -> None:
    for slot, actor in enumerate(base.objects):
        if slot != int(base.target_slot[0]):
            actor.set_pose(Pose.create_from_pq(torch.tensor([[-2.0, slot * 0.3 - 2.0, 0.1]]), actor.pose.q))


def find_covered_seed(env) -> int:
    """Return a seed whose target is not cleared at the start."""
    for seed in range(20):
        _, info = env.reset(seed=seed)
        if not bool(info["obstacles_cleared"][0]):
            return seed
    raise AssertionError("every target is clear at once")


def test_target_of_a_heap_is_partly_hidden(env):
    env.reset(seed=0)
    base = env.unwrapped
    layout = base.layout()
    assert layout.visible_fractions[layout.target] < base.task_config.target.max_visible_share
    found = base.measure_clutter()
    assert found.hidden_fraction.shape == (1,)
    assert found.obstacles.shape == (1, 8)
    assert not bool(found.obstacles[0, layout.target])


def test_removing_other_objects_clears_the_target_until_the_next_reset(env):
    seed = find_covered_seed(env)
    base = env.unwrapped
    before = base.get_state()
    assert not hold_until_measured(env)
    remove_other_objects(base)
    assert hold_until_measured(env)
    assert base.hidden_fraction.tolist() == [0]
    base.set_state(before)
    assert hold_until_measured(env)  # sticky
    _, info = env.reset(seed=seed)
    assert not bool(info["obstacles_cleared"][0])


def test_clutter_is_measured_five_times_per_second(env):
    env.reset(seed=find_covered_seed(env))
    base = env.unwrapped
    qpos = base.agent.robot.get_qpos()[0, 3:10].numpy()
    remove_other_objects(base)
    seen = []
    for _ in range(4):
        *_, info = env.step(np.append(qpos, 1.0).astype(np.float32))
        seen.append(bool(info["obstacles_cleared"][0]))
        assert not bool(info["cleared_at_reset"][0])
    assert seen == [False, False, False, True]


def test_cleared_at_reset_reports_a_target_that_was_clear_at_the_start(env, monkeypatch):
    monkeypatch.setattr(occlusion.Clutter, "is_target_cleared", property(lambda found: found.hidden_fraction <= 1))
    _, info = env.reset(seed=0)
    assert bool(info["obstacles_cleared"][0])
    assert bool(info["cleared_at_reset"][0])
    *_, info = env.step(np.append(env.unwrapped.agent.robot.get_qpos()[0, 3:10].numpy(), 1.0).astype(np.float32))
    assert bool(info["cleared_at_reset"][0])
    monkeypatch.undo()
    _, info = env.reset(seed=find_covered_seed(env))
    assert not bool(info["cleared_at_reset"][0])


def test_restored_heap_is_measured_in_the_next_step(env):
    seed = find_covered_seed(env)
    base = env.unwrapped
    before, share = base.get_state_dict(), base.hidden_fraction.clone()
    remove_other_objects(base)
    assert hold_until_measured(env)
    cleared = base.get_state_dict()
    base.set_state_dict(before)
    info = base.get_info()
    assert torch.equal(base.hidden_fraction, share)
    assert not bool(info["obstacles_cleared"][0])
    env.reset(seed=seed)
    base.set_state_dict(cleared)
    info = base.get_info()
    assert base.hidden_fraction.tolist() == [0]  # it is not measured any more
    base.set_state_dict({**cleared, "task": {"stages": cleared["task"]["stages"]}})  # missing entries stay unchanged
    assert base.hidden_fraction.tolist() == [0]
    assert bool(info["obstacles_cleared"][0])
    assert not bool(info["cleared_at_reset"][0])


def test_target_that_was_pulled_out_or_fell_is_not_cleared(env):
    seed = find_covered_seed(env)
    base = env.unwrapped
    base.success_check.stages["target_grasped"][:] = True  # and was released since
    remove_other_objects(base)
    assert not hold_until_measured(env)
    env.reset(seed=seed)
    target = base.objects[int(base.target_slot[0])]
    target.set_pose(Pose.create_from_pq(torch.tensor([[-1.0, -1.0, 0.1]]), target.pose.q))
    assert not hold_until_measured(env)


def test_policy_finds_the_target_and_reports_moved_objects(tmp_path):
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


def test_schedule_is_due_before_the_first_step_and_every_period():
    schedule = PeriodicSchedule(4, 3, "cpu")
    found = []
    for step in range(10):
        if step == 4:
            schedule.reset(np.array([1, 2]))
        if step == 8:
            schedule.make_always_due(np.array([3]))
        found.append(schedule.due_envs().tolist())
        schedule.advance()
    assert found == [[0, 1, 2, 3], [], [], [0, 1, 2, 3], [1, 2], [], [0, 3], [1, 2], [3], [0, 3]]
    schedule.reset(np.array([3]))
    schedule.advance()
    assert schedule.due_envs().tolist() == []
