"""Scripted policy of search: look, clear what covers and surrounds the target, grasp it, carry it to the basket."""

from __future__ import annotations

from collections import Counter

import numpy as np

from robocas_ms3.errors import EpisodeLost, PlanningFailed
from robocas_ms3.language.templates import subgoal
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.grasping import grasp
from robocas_ms3.planning.skills.looking import FAR, NEAR, hidden_share, look_at
from robocas_ms3.planning.skills.placing import carry_to_basket, release_into_basket
from robocas_ms3.planning.skills.pushing import push_away, surface_in_base
from robocas_ms3.planning.skills.removing import blockers, hang_clear, remove
from robocas_ms3.scenes.placement import transform
from robocas_ms3.tasks.occlusion import MAX_HIDDEN_SHARE
from robocas_ms3.tasks.search import FALLEN, RoboCASSearchEnv
from robocas_ms3.tasks.spec import SEARCH

REMOVALS = 8  # pushes and removals a demonstration may hold, in vain or not
MOVED = 0.02  # m by which a push moves its object at least; less is one in vain
LIFT_FIRST = 0.3  # how often an attempt after the first lifts what it might push
HEIGHT_NOISE = 0.01  # m, so that another attempt may begin with another of two that are about as high
LIFT_HEIGHT = 0.15  # m, upstream's
CLEARING_SECONDS = 0.85 * SEARCH.max_episode_steps / 20  # after which an attempt that still clears is given up


def attempt(arm: Arm) -> None:
    """Try once, from wherever the episode stands; returns when the task has succeeded.

    Raises:
        PlanningFailed: with the stage that could not be done.
    """
    slot = int(arm.env.target_slot[0])
    words = arm.env.target_asset().asset.name, arm.env.task_config.support
    find, take = subgoal("find the object", *words), subgoal("move and grasp", *words)
    clearing = _Clearing(arm, slot)
    arm.executor.label(**find)
    if not arm.executor.at_checkpoint:
        look_at(arm, clearing.middle(slot), FAR)
    while True:
        obstacles = clearing.obstacles()
        if not obstacles or (clearing.stuck and clearing.visible):
            try:
                arm.executor.label(**take)
                _grasp(arm, slot)
                break
            except _NoWayIn:
                arm.executor.label(**find)
                obstacles = [*obstacles, *blockers(arm, slot)]
        if clearing.clear_one(obstacles):
            look_at(arm, clearing.middle(slot), NEAR)
            clearing.check()
            arm.executor.mark()
    hang_clear(arm, slot)
    arm.executor.label(**subgoal("transfer object", *words))
    carry_to_basket(arm, slot)
    clearing.check_surface()
    release_into_basket(arm, slot)


class _NoWayIn(Exception):
    """No grasp of the target can be planned as things stand; nothing has moved yet."""


def _grasp(arm: Arm, slot: int) -> None:
    """Grasp the target and lift it.

    Raises:
        _NoWayIn: no grasp can be planned.
        PlanningFailed: it was missed or slipped.
    """
    done = len(arm.executor.actions)
    try:
        arm.executor.gripper = OPEN  # it opens on the way
        grasp(arm, slot, lift_height=LIFT_HEIGHT)
    except PlanningFailed as error:
        if len(arm.executor.actions) > done:
            raise
        raise _NoWayIn from error


class _Clearing:
    """Makes room around the target, one object at a time; remembers what did not help.

    Args:
        arm: the attempt's tools.
        target: slot of the target.
    """

    def __init__(self, arm: Arm, target: int) -> None:
        assert isinstance(arm.env, RoboCASSearchEnv)
        self._arm, self._env, self._target = arm, arm.env, target
        self._tried: Counter[int] = Counter()
        self.stuck = False
        self._hopeless: set[tuple[str, int]] = set()  # what can't be planned as things stand
        for fact in ("pushes", "pushes_in_vain", "removals"):
            arm.executor.facts.setdefault(fact, 0)

    def obstacles(self) -> list[int]:
        """What has to go, the highest first; empty: the target is free, by the paper's rule."""
        found = self._env.clutter()
        slots = np.flatnonzero(found.obstacles[0].cpu().numpy()).tolist()
        if bool(found.cleared[0]) and self.visible:
            return []
        height = {slot: self._points(slot)[:, 2].max() + self._arm.rng.normal(0, HEIGHT_NOISE) for slot in slots}
        return sorted(slots, key=lambda slot: -height[slot])

    @property
    def visible(self) -> bool:
        """Whether the gripper's camera sees most of the target."""
        return hidden_share(self._arm, self._target) <= MAX_HIDDEN_SHARE

    def clear_one(self, obstacles: list[int]) -> bool:
        """Push an object aside or lift it away: the first one of a list that can be moved.

        Returns:
            Whether one was moved. If none can be, though most of the target is to be seen, this is `stuck`, and a grasp
            may be tried as things stand.

        Raises:
            PlanningFailed: none can be moved, one was lost on the way, or enough has been moved.
        """
        if sum(self._arm.executor.facts.values()) >= REMOVALS:
            raise EpisodeLost("horizon", "too_many_obstacles")
        order = list(dict.fromkeys(obstacles))
        if self.stuck:
            order += [slot for first in obstacles[:2] for slot in blockers(self._arm, first) if slot not in order]
        failure = PlanningFailed("clear", "nothing_to_move")
        for slot in sorted(set(order) - {self._target}, key=lambda slot: (self._tried[slot] > 1, order.index(slot))):
            # what a push did not move is lifted next time; where pushing went wrong, another attempt may lift first
            lift_first = self._tried[slot] or (self._arm.attempt > 0 and self._arm.rng.uniform() < LIFT_FIRST)
            skills = ("removals", "pushes") if lift_first else ("pushes", "removals")
            for skill in skills:
                if (skill, slot) in self._hopeless:
                    continue
                self._arm.rise_clear()
                done = len(self._arm.executor.actions)
                try:
                    self._use(skill, slot)
                    self.stuck = False
                    self._hopeless.clear()
                    return True
                except PlanningFailed as error:
                    failure = error
                    if len(self._arm.executor.actions) > done:  # it failed on the way, not in planning
                        raise
                    self._hopeless.add((skill, slot))
        if self.stuck:
            raise failure
        self.stuck = True
        return False

    def _use(self, skill: str, slot: int) -> None:
        arm, fact = self._arm, skill
        if skill == "pushes":
            before = self.middle(slot)
            push_away(arm, slot, self._target)
            if np.linalg.norm(self.middle(slot) - before) <= MOVED:
                fact = "pushes_in_vain"
        else:
            arm.executor.gripper = OPEN  # it opens on the way
            remove(arm, slot)
        arm.executor.facts[fact] += 1
        self._tried[slot] += 1

    def check(self) -> None:
        """See that nothing has been pushed off the table, and that there is time left.

        Raises:
            EpisodeLost: otherwise.
        """
        self.check_surface()
        if len(self._arm.executor.actions) * self._arm.executor.dt > CLEARING_SECONDS:
            raise EpisodeLost("horizon", "clearing_takes_too_long")

    def check_surface(self) -> None:
        """See that nothing has fallen off the table since the reset.

        Raises:
            EpisodeLost: otherwise.
        """
        frame, _ = surface_in_base(self._arm)
        present = np.flatnonzero(self._env.present[0].cpu().numpy()).tolist()
        if any(self._arm.scene.object_in_base(slot)[2, 3] < frame[2, 3] - FALLEN for slot in present):
            raise EpisodeLost("clear", "fell_off_table")

    def middle(self, slot: int) -> Array:
        """(3,) middle of an object's surface, in the arm's base frame, m."""
        return self._points(slot).mean(axis=0)

    def _points(self, slot: int) -> Array:
        return transform(self._arm.scene.object_in_base(slot), self._env.object_assets[0][slot].surface_points())
