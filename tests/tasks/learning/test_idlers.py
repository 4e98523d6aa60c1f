"""Dense rewards of demonstrations, and of demonstrations cut short.

Idlers are demonstrations that stop somewhere and hold still from then on, as a policy would that has found a reward it
likes. None may earn more than going on does, in whatever way rewards are summed up.
"""

from __future__ import annotations

import gymnasium as gym
import h5py
import numpy as np
import pytest
from learning_envs import STATE_ONLY, held_still
from scipy.stats import spearmanr

import robocas_ms3  # noqa: F401
from robocas_ms3.demos.episode import EpisodeGenerator, EpisodeSettings
from robocas_ms3.tasks import TASKS

DEMONSTRATED = {
    "pick": ("pick_table_scattered", 0),
    "select": ("select_table_orderly", 0),
    "search": ("search_table_small_heap", 3),
    "open_pick": ("open_pick_drawer", 0),
}
HELD = 40  # steps that an idler is watched for
HORIZON = 1000  # steps that it goes on in the same way


class Demonstration:
    """A recorded episode, played again for its rewards."""

    def __init__(self, task: str, folder) -> None:
        config, seed = DEMONSTRATED[task]
        generator = EpisodeGenerator(EpisodeSettings(task, config, "builtin", replay_rate=0))
        while not generator.generate(seed, folder, "demonstration").success:
            seed += 1
        generator.close()
        with h5py.File(folder / "demonstration.h5") as file:
            self.actions = np.array(file["traj_0"]["actions"])
        self.seed, self.task = seed, task
        self.env = gym.make(
            TASKS[task].env_id, config=config, obs_mode="none", reward_mode="normalized_dense", **STATE_ONLY
        )
        self.levels, self.infos = self.play(len(self.actions))

    def play(self, count: int, then: int = 0) -> tuple[np.ndarray, list[dict]]:
        """Rewards and infos of so many actions, and of holding still for some steps."""
        self.env.reset(seed=self.seed)
        levels, infos = [], []
        start = np.append(held_still(self.env)[:7], 1.0).astype(np.float32)
        last = self.actions[count - 1] if count else start
        for action in [*self.actions[:count], *[last] * then]:
            _, reward, *_, info = self.env.step(action)
            levels.append(reward.item())
            infos.append(info)
        return np.array(levels), infos

    def first(self, flag: str) -> int:
        """The step after which a flag was set for the first time."""
        return next(i for i, info in enumerate(self.infos) if info[flag][0])


@pytest.fixture(scope="module", params=DEMONSTRATED)
def demonstration(request, tmp_path_factory):
    made = Demonstration(request.param, tmp_path_factory.mktemp("demonstrations"))
    yield made
    made.env.close()


@pytest.mark.slow
class TestDemonstrations:
    def test_the_reward_of_a_demonstration_rises(self, demonstration):
        levels = demonstration.levels
        assert levels.min() >= 0
        won = np.array([bool(info["success"][0]) for info in demonstration.infos])
        assert won[-1]
        assert ((levels == 1) == won).all()
        assert not any(info["fail"][0] for info in demonstration.infos)
        assert spearmanr(np.arange(len(levels)), levels)[0] > 0.8
        tenths = [part.mean() for part in np.array_split(levels, 5)]
        assert tenths == sorted(tenths)

    def test_every_stage_is_worth_more_than_the_one_before(self, demonstration):
        steps = [demonstration.first(flag) for flag in ("reached_target", "target_grasped", "target_lifted", "success")]
        first = {"search": "obstacles_cleared", "open_pick": "furniture_opened"}.get(demonstration.task)
        if first:
            steps.insert(0, demonstration.first(first))
        found = [demonstration.levels[step] for step in steps]
        assert found == sorted(found)
        assert len(set(found)) >= len(found) - 1  # what is touched may be held in the same step

    def test_who_stops_on_the_way_earns_less(self, demonstration):
        """At the start, above the target, holding it, having lifted it, and above the basket."""
        levels, first = demonstration.levels, demonstration.first
        released = max(i for i, action in enumerate(demonstration.actions) if action[7] < 0)
        touched, held, lifted = map(first, ("reached_target", "target_grasped", "target_lifted"))
        stops = [0, touched - 2, held + 1, lifted, released]
        if demonstration.task in {"search", "open_pick"}:
            stops.insert(1, stops[1] // 2)  # while the heap is cleared, the furniture opened
        going_on = levels.sum() + (HORIZON - len(levels)) * 1.0
        reached = []
        for stop in stops:
            idle, infos = demonstration.play(stop, then=HELD)
            assert not any(info["success"][0] for info in infos)
            best = idle[stop:].max()
            reached.append(best)
            # while episodes go on after a success
            assert idle[:stop].sum() + (HORIZON - stop) * best < going_on
            # where a success ends them: what an episode of `progress` sums up to
            assert best - idle[0] < 0.95 - levels[0]
        assert reached[-1] == max(reached)
        assert reached[0] == min(reached)
