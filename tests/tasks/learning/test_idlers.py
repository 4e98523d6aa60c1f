"""Dense rewards of demonstrations, and of policies that leave them on the way.

Idlers stop somewhere and hold still from then on, as a policy would that has found a reward it likes. Harvesters go
back and forth, to collect the same reward twice. Neither may have a greater return than continuing the demonstration.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import pytest
from scipy.stats import spearmanr

import robocas_ms3  # noqa: F401
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.tasks import TASKS

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_pos"}
OPEN, CLOSED = 1.0, -1.0  # the gripper's command, the last number of an action


class Demonstration:
    """A recorded episode.

    Attributes:
        actions: (T, 8) joint positions, and the gripper's command.
        levels: (T,) of ``normalized_dense``.
        infos: T of them.
        stages: (T,) place of the stage that each step's reward is of in the task's table.
        released: the step in which the gripper lets go of the target.
    """

    def __init__(self, task: str, config: str, seed: int, folder: Path) -> None:
        generator = EpisodeGenerator(EpisodeSettings(task, config, "builtin", check_rate=0))
        while not generator.generate(seed, folder, "demonstration").success:
            seed += 1
        generator.close()
        with h5py.File(folder / "demonstration.h5") as file:
            self.actions = np.array(file["traj_0"]["actions"])
        self.task = task
        self.env = gym.make(
            TASKS[task].env_id, config=config, obs_mode="none", reward_mode="normalized_dense", **STATE_ONLY
        )
        self.env.reset(seed=seed)
        self._states, levels, self.infos = [], [], []
        for action in self.actions:
            self._states.append(self.env.unwrapped.get_state_dict())
            _, reward, *_, info = self.env.step(action)
            levels.append(reward.item())
            self.infos.append(info)
        self.levels = np.array(levels)
        table = self.env.unwrapped.REWARDS
        full = [
            [[info["reward_terms"][name] == 1 for name in own] for own in table.stages.values()] for info in self.infos
        ]
        self.stages = np.array([[*map(all, terms), False].index(False) for terms in full])
        self.released = int(np.flatnonzero(self.actions[:, 7] < 0)[-1])

    def first(self, flag: str) -> int:
        """Return the step after which a flag was first set."""
        return next(i for i, info in enumerate(self.infos) if info[flag][0])

    def leave(self, step: int, actions: Iterable[np.ndarray]) -> tuple[np.ndarray, list[dict]]:
        """Return rewards and infos of other actions that replace the demonstration from a step on."""
        self.env.unwrapped.set_state_dict(self._states[step])
        levels, infos = [], []
        for action in actions:
            _, reward, *_, info = self.env.step(action)
            levels.append(reward.item())
            infos.append(info)
        return np.array(levels), infos

    def path(self, first: int, last: int, gripper: float) -> list[np.ndarray]:
        """Return the actions between two steps, inclusive; reversed if the second step is earlier."""
        steps = range(first, last + 1) if first <= last else range(first, last - 1, -1)
        return [np.append(self.actions[step, :7], gripper).astype(np.float32) for step in steps]


DEMONSTRATED = [
    ("pick", "pick_table_scattered", 0),
    ("pick", "pick_side_table_scattered", 0),  # the basket stands on the floor
    ("select", "select_shelf_orderly", 0),  # and lower than the shelf
    ("search", "search_table_small_heap", 3),
    ("open_pick", "open_pick_drawer", 0),
]
IDLE_STEPS = 40  # observed steps of a stopped policy
HORIZON = 1000  # steps of the assumed continuation after the demonstration


@pytest.fixture(scope="module", params=DEMONSTRATED, ids=lambda row: row[1])
def demonstration(request, tmp_path_factory):
    made = Demonstration(*request.param, tmp_path_factory.mktemp("demonstrations"))
    yield made
    made.env.close()


def has_smaller_return(demonstration: Demonstration, step: int, levels: np.ndarray, stays: float) -> bool:
    """Return whether a policy that leaves at a step, with a final reward ``stays``, has a smaller return."""
    went = demonstration.levels
    end = len(went) + HORIZON
    # if episodes continue after a success
    going_on = went.sum() + HORIZON * 1.0
    instead = went[:step].sum() + levels.sum() + (end - step - len(levels)) * stays
    # if a success ends them: sum of `progress`
    return instead < going_on and stays - went[0] < 0.95 * (1 - went[0])


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
        assert len(set(found)) >= len(found) - 1  # touching and holding may start in the same step

    def test_policy_that_stops_has_a_smaller_return(self, demonstration):
        """Stop in the middle of each stage, at the start of the next one, and just before the target is released."""
        changes = np.flatnonzero(np.diff(demonstration.stages)) + 1
        bounds = [0, *changes[changes < demonstration.released], demonstration.released]
        stops = sorted({*bounds, *((first + last) // 2 for first, last in zip(bounds, bounds[1:], strict=False))})
        assert len(stops) >= 9
        reached = []
        for stop in stops:
            held = demonstration.actions[max(stop - 1, 0)]
            levels, infos = demonstration.leave(stop, [held] * IDLE_STEPS)
            assert not any(info["success"][0] for info in infos)
            assert has_smaller_return(demonstration, stop, levels, levels.max())
            reached.append(levels[-1])
        assert reached[-1] > 0.97 * max(reached)
        assert reached[0] == min(reached)

    def test_closed_fingers_have_at_most_the_reward_of_reaching(self, demonstration):
        grasped = demonstration.first("target_grasped")
        start = grasped - 50  # before the target is between the fingers
        path = demonstration.path(start, grasped, CLOSED)
        levels, infos = demonstration.leave(start, [*path, *path[-1:] * IDLE_STEPS])
        assert not any(info["success"][0] for info in infos)
        assert levels[-1] < demonstration.levels[grasped]  # the fingers may throw it up, which counts as a short grasp
        assert has_smaller_return(demonstration, start, levels, levels.max())

    def test_going_back_and_forth_has_at_most_the_return_of_staying(self, demonstration):
        """Move the held target; release it and grasp it again; open the furniture partly and close it."""
        opens = ["opens"] if demonstration.task == "open_pick" else []
        for way in ["carries", "grasps_again", *opens]:
            self.oscillate(demonstration, way)

    def oscillate(self, demonstration, way):
        first, path = demonstration.first, demonstration.path
        grasped, lifted = first("target_grasped"), first("target_lifted") + 3
        if way == "carries":
            start = (lifted + demonstration.released) // 2
            cycle = [*path(start, lifted, CLOSED), *path(lifted, start, CLOSED)]
        elif way == "grasps_again":
            start, there = lifted, path(grasped, lifted, CLOSED)
            cycle = [*there[::-1], *path(grasped, grasped, OPEN) * 6, *there[:1] * 6, *there]
        else:
            start = first("furniture_opened") - 2
            cycle = [*path(start, start - 30, CLOSED), *path(start - 30, start, CLOSED)]
        stays, _ = demonstration.leave(start, cycle[:1] * IDLE_STEPS)
        levels, infos = demonstration.leave(start, cycle * 2)
        assert not any(info["success"][0] for info in infos)
        assert levels.mean() < stays.max(), way
        assert has_smaller_return(demonstration, start, levels, levels.max()), way
