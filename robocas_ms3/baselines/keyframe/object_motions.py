"""Grasp an object, and carry it to the basket or to a free place."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.arm_control import (
    CLOSED,
    COARSE,
    NEAR_START,
    OPEN,
    ArmControl,
    Command,
    EpisodeObservation,
    Motion,
    MotionError,
)
from robocas_ms3.baselines.keyframe.chosen_grasp import ChosenGrasp
from robocas_ms3.baselines.keyframe.free_paths import FreePaths
from robocas_ms3.baselines.keyframe.free_places import HeightMap
from robocas_ms3.baselines.keyframe.motion import LIFT
from robocas_ms3.baselines.keyframe.tcp_poses import find_release_poses
from robocas_ms3.core.poses import Array, from_rotation

_EMPTY = 0.003  # m, gripper width below which nothing is held
_RELEASE_CLEARANCE = 0.03  # m between the rim of the basket and the lowest point of a held object
_CARRY_CLEARANCE = 0.15  # m between the rim and the TCP on the way to the basket
_LOWERED, _LOWERINGS = 0.12, 12  # m that an object from a compartment is lowered; number of poses that are tried
_PLACE_HEIGHT = 0.38  # m, least height of the TCP on the way to a free place
_DROP = 0.02  # m that an object falls at a free place
_PLACE_POSES = 10  # poses at free places that are tried
_TARGET_GAP, _BASKET_GAP = 0.16, 0.28  # m between a free place and the target, and the basket
_COMPARTMENT_SPEED = 0.5  # fraction of the limits with an object that was grasped from the front
_log = logging.getLogger(__name__)


@dataclass
class Memory:
    """Observations and attempts of an episode.

    Attributes:
        table: height of the surface, m.
        focus: (2,) place that the next view shows, m.
        basket: (3,) middle of the basket in x and y, and the height of its rim, m; None: not seen.
        is_front: whether objects have to be grasped from the front.
        height_map: observed heights.
        failed: TCP poses (4, 4) of failed grasps.
    """

    table: float
    focus: Array = field(default_factory=lambda: np.array([0.6, 0.0]))
    basket: Array | None = None
    is_front: bool = False
    height_map: HeightMap = field(default_factory=HeightMap)
    failed: list[Array] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Release:
    """Configuration ``start`` (7,) over the basket, and the path (n, 7) down to the release pose; None: it is there."""

    start: Array
    down: Array | None = None


class ObjectMotions:
    """Motions with objects.

    Args:
        arm: motions of the arm.
        free: joint motions that keep clear of observed points.
        memory: what was observed and tried.
    """

    def __init__(self, arm: ArmControl, free: FreePaths, memory: Memory) -> None:
        self._arm, self._free, self._memory = arm, free, memory

    def _grasp(
        self, observation: EpisodeObservation, chosen: ChosenGrasp
    ) -> Generator[Command, EpisodeObservation, tuple[EpisodeObservation, bool]]:
        """Grasp and lift; return the last observation, and whether the gripper holds something."""
        approach, arm, holds = chosen.approach, self._arm, False
        try:
            if approach.exit_path is None or chosen.path is None:
                observation = yield from arm.rise(observation, chosen.safe_height, OPEN)
                observation = yield from arm.move_joints(observation, approach.start, OPEN, NEAR_START)
                observation = yield from arm.move_straight(observation, approach.grasp, OPEN)
                observation = yield from arm.wait(observation, CLOSED)
                observation = yield from arm.rise(observation, float(observation.tcp_in_base[2, 3]) + LIFT, CLOSED)
            else:
                observation = yield from arm.follow(observation, chosen.path, OPEN, NEAR_START)
                observation = yield from arm.follow_or_return(observation, approach.path, OPEN)
                observation = yield from arm.wait(observation, CLOSED)
                observation = yield from self._leave(observation, approach.exit_path)
            holds = observation.width >= _EMPTY
        except MotionError as error:
            observation = error.observation
            _log.debug("no path to or from a grasp")
        if not holds:
            self._memory.failed.append(approach.grasp)
        return observation, holds

    def _leave(self, observation: EpisodeObservation, exit_path: Array) -> Motion:
        """Leave a compartment with the grasped object; release it and raise MotionError if the arm is stopped."""
        try:
            return (yield from self._arm.follow_or_return(observation, exit_path, CLOSED, speed=_COMPARTMENT_SPEED))
        except MotionError as error:
            observation = yield from self._release_and_leave(error.observation, exit_path)
            raise MotionError(observation) from error

    def _release_and_leave(self, observation: EpisodeObservation, exit_path: Array) -> Motion:
        """Open the gripper in a compartment, and leave it from the present place on."""
        observation = yield from self._arm.wait(observation, OPEN)
        nearest = self._arm.find_nearest(observation, exit_path)
        return (yield from self._arm.follow(observation, exit_path[nearest:], OPEN))

    def move(
        self,
        observation: EpisodeObservation,
        chosen: ChosenGrasp,
        transfer: Callable[[EpisodeObservation, ChosenGrasp], Motion],
    ) -> Motion:
        """Grasp an object, transfer it by ``transfer``, and release it; put it back if there is no path."""
        observation, holds = yield from self._grasp(observation, chosen)
        if not holds:
            return observation
        approach = chosen.approach
        try:
            observation = yield from transfer(observation, chosen)
        except MotionError as error:
            observation = error.observation
            _log.debug("no path for a held object")
            self._memory.failed.append(approach.grasp)
            if approach.exit_path is None:
                with suppress(MotionError):
                    observation = yield from self._arm.move_straight(observation, approach.grasp, CLOSED)
            else:
                back = approach.exit_path[::-1]
                observation = yield from self._arm.follow(observation, back, CLOSED, speed=_COMPARTMENT_SPEED)
                return (yield from self._release_and_leave(observation, approach.exit_path))
        return (yield from self._arm.wait(observation, OPEN))

    def carry(self, observation: EpisodeObservation, chosen: ChosenGrasp) -> Motion:
        """Carry the held object over the basket."""
        memory, arm = self._memory, self._arm
        if memory.basket is None:
            raise MotionError(observation)
        upright = chosen.approach.grasp[2, :3] if memory.is_front else None
        point = memory.basket + [0, 0, _RELEASE_CLEARANCE + chosen.depth_below_tcp]
        releases = self._plan_releases(point, upright, observation.qpos)
        height = float(memory.basket[2]) + max(_CARRY_CLEARANCE, _RELEASE_CLEARANCE + chosen.depth_below_tcp)
        height = height if memory.is_front else max(chosen.safe_height, height)
        if not releases:
            raise MotionError(observation)
        try:
            observation = yield from arm.rise(observation, height, CLOSED)
        except MotionError as error:
            if not memory.is_front:
                raise
            observation = error.observation
        points, speed = chosen.scene.points[chosen.object.mask], _COMPARTMENT_SPEED if memory.is_front else 1.0
        for by_rest in (False, True) if memory.is_front else (False,):  # the rest pose may be close to a table
            self._free.hold(points, chosen.approach.grasp)
            found = self._free.choose(observation.qpos, releases, lambda release: release.start, by_rest=by_rest)
            self._free.release()
            if found is None or observation.width < _EMPTY:
                break
            release, path = found
            releases = [one for one in releases if one is not release]
            try:
                observation = yield from arm.follow_or_return(observation, path, CLOSED, COARSE, speed)
            except MotionError as error:
                observation = error.observation
                _log.debug("stopped on the way to the basket")
                continue
            if release.down is not None:
                observation = yield from arm.follow(observation, release.down, CLOSED, COARSE, speed)
            return observation
        raise MotionError(observation)

    def _plan_releases(self, point: Array, upright: Array | None, qpos: Array) -> list[_Release]:
        """Return releases at a TCP position (3,), the nearest first; at a compartment from above, if possible.

        upright: see `find_release_poses`. qpos: (7,) present configuration, rad.
        """
        paths = self._arm.paths
        if self._memory.is_front:  # the object may come from below the rim
            poses, costs = find_release_poses(point + [0, 0, _LOWERED], upright)
            lines, goals = [], poses.copy()
            goals[:, 2, 3] -= _LOWERED
            for index, above in paths.nearest(poses, costs, qpos, 0.5):
                down = paths.straight(above, goals[index], sequential=False)
                if down is not None:
                    lines.append(_Release(above, down))
                if len(lines) == _LOWERINGS:
                    break
            if lines:
                return lines
        poses, costs = find_release_poses(point, upright)
        return [_Release(found) for _, found in paths.nearest(poses, costs, qpos, 0.5)]

    def place(self, observation: EpisodeObservation, chosen: ChosenGrasp) -> Motion:
        """Place the held object at a free place of the surface."""
        poses, costs = [], []
        avoid = [(self._memory.focus, _TARGET_GAP)]
        if self._memory.basket is not None:
            avoid.append((self._memory.basket[:2], _BASKET_GAP))
        for place in self._memory.height_map.find_free_places(
            self._memory.table, observation.tcp_in_base[:2, 3], avoid
        ):
            for turn in np.arange(-np.pi, np.pi, np.pi / 4):
                rotation = Rotation.from_euler("z", turn).as_matrix() @ chosen.approach.grasp[:3, :3]
                poses.append(from_rotation([*place, self._memory.table + chosen.depth_below_tcp + _DROP], rotation))
                costs.append(2 * float(np.linalg.norm(place - observation.tcp_in_base[:2, 3])))
        if not poses:
            raise MotionError(observation)
        above = np.array(poses)
        above[:, 2, 3] += LIFT
        nearest = self._arm.paths.nearest(above, np.array(costs), observation.qpos, 0.5)
        for index, qpos in nearest[:_PLACE_POSES]:
            if self._arm.paths.straight(qpos, poses[index]) is not None:
                observation = yield from self._arm.rise(observation, max(chosen.safe_height, _PLACE_HEIGHT), CLOSED)
                observation = yield from self._arm.move_joints(observation, qpos, CLOSED)
                return (yield from self._arm.move_straight(observation, poses[index], CLOSED))
        raise MotionError(observation)
