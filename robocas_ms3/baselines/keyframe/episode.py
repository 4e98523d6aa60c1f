"""One episode of `keyframe`: view the scene, choose the next keyframe, execute it, and repeat."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator
from contextlib import suppress
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.arm_control import (
    CLOSED,
    COARSE,
    OPEN,
    ArmControl,
    Command,
    EpisodeObservation,
    Motion,
    MotionError,
)
from robocas_ms3.baselines.keyframe.config import DecisionSettings
from robocas_ms3.baselines.keyframe.free_paths import FreePaths
from robocas_ms3.baselines.keyframe.free_places import HeightMap
from robocas_ms3.baselines.keyframe.front_approaches import Front, plan_front_approaches
from robocas_ms3.baselines.keyframe.grasp_proposals import compute_similarity, propose_colliding_grasps, propose_grasps
from robocas_ms3.baselines.keyframe.handles import Handle
from robocas_ms3.baselines.keyframe.keyframes import Keyframe
from robocas_ms3.baselines.keyframe.motion import LIFT
from robocas_ms3.baselines.keyframe.observed_scene import ObservedObject, ObservedScene
from robocas_ms3.baselines.keyframe.obstacles import find_middle, score_blocking, score_height
from robocas_ms3.baselines.keyframe.perception import Perception, Request
from robocas_ms3.baselines.keyframe.targets import TargetChoice
from robocas_ms3.baselines.keyframe.tcp_poses import TOP_VIEWS_DEG, find_release_poses, find_views
from robocas_ms3.core.poses import Array, from_rotation, inverse

_TABLE = 0.12  # m, height of a table in the arm's base frame if it is not seen
_VIEW_HEIGHT = 0.4  # m of the TCP before it moves to a view
_FALLBACK_DISTANCES = (0.3, 0.35, 0.4, 0.45, 0.25)  # m from the camera to a point that is nearer to the base
_NEAR_START = (0.008, 0.05)  # m and rad from the pre-grasp at which the motion to it ends
_EMPTY = 0.003  # m, gripper width below which nothing is held
_RELEASE_CLEARANCE = 0.03  # m between the rim of the basket and the lowest point of a held object
_CARRY_CLEARANCE = 0.15  # m between the rim and the TCP on the way to the basket
_LOWERED, _LOWERINGS = 0.12, 12  # m that an object from a compartment is lowered into the basket; poses that are tried
_PLACE_HEIGHT = 0.38  # m, least height of the TCP on the way to a free place
_DROP = 0.02  # m that an object falls at a free place
_FAILURE_PENALTY = 2.0  # of the score of a grasp that equals a failed one; scores are probabilities
_PLACE_POSES = 10  # poses at free places that are tried
_TARGET_GAP, _BASKET_GAP = 0.16, 0.28  # m between a free place and the target, and the basket
_IN_BASKET = 0.14  # m from the middle of the basket, within which an object is in it
_SURVEY_INTERVAL = 3  # from one survey to the next, in views of a compartment without the target
_MAX_OBSTACLES = 5  # obstacles for which grasps are computed per decision
_MAX_PULLS, _PULL_SPEED = 4, 0.3  # pulls per episode; fraction of the limits
_COMPARTMENT_SPEED = 0.5  # fraction of the limits with an object that was grasped from the front
_MIN_PULL = 0.08  # m, length of a pull below which a door or drawer is open
_FRONT_VIEWS_DEG = (40, 30, 50, 20)  # elevations of the gripper camera before a compartment, degrees
_log = logging.getLogger(__name__)


class KeyframeEpisode:
    """Decisions and motions of one episode.

    Args:
        perception: networks.
        arm: motions of the arm.
        settings: settings of the decisions.
        request: what the instruction asks for.
        rng: random generator of the proposals.
        hand_camera: name of the camera on the hand.
    """

    def __init__(
        self,
        perception: Perception,
        arm: ArmControl,
        settings: DecisionSettings,
        request: Request,
        rng: np.random.Generator,
        hand_camera: str,
    ) -> None:
        self._perception, self._arm, self._settings = perception, arm, settings
        self._request, self._rng, self._hand_camera = request, rng, hand_camera
        self._targets = TargetChoice(request.relation)
        self._failed: list[Array] = []  # TCP poses of failed grasps
        self._map = HeightMap()
        self._table, self._focus = _TABLE, np.array([0.6, 0.0])
        self._basket: Array | None = None  # middle in x and y, and height of the rim
        self._handle: Handle | None = None
        self._front: Front | None = None  # of a compartment that had a closed door
        self._is_front, self._sees_objects, self._pulls = False, False, 0
        self._camera_in_tcp = np.eye(4)

    def run(self, observation: EpisodeObservation) -> Motion:
        """Run the episode from its first observation, which has images, until it is ended from outside."""
        self._free = FreePaths(self._arm.paths, observation.qpos)
        self._survey(observation)
        observation = yield from self._open_compartment(observation)
        close, without_target = False, 0
        while True:
            observation = yield from self._view(observation, close)
            if self._basket is None:
                self._basket = self._perception.survey(list(observation.frames.values()), self._table).basket
            scene = self._perception.observe(observation.frames[self._hand_camera], self._request, self._table)
            self._map.update(scene.points)
            target = self._targets.choose([one for one in scene.targets if not self._is_in_basket(one)])
            chosen, without_target = None, without_target + 1
            if target is not None:
                without_target = 0
                self._focus = scene.points[target.mask].mean(axis=0)[:2]
                chosen = self._plan_grasp(scene, target, observation)
            if chosen is not None:
                observation = yield from self._move(observation, chosen, self._carry)
                close = False
                continue
            chosen = None if self._is_front else self._choose_obstacle(scene, target, observation)
            if chosen is not None:
                observation = yield from self._move(observation, chosen, self._place)
                close = False
                continue
            _log.debug("no keyframe; the target is %s", "not seen" if target is None else "seen")
            close = not close
            if without_target % _SURVEY_INTERVAL == 1 and (self._is_front or self._pulls):
                self._survey(observation)
                if not self._sees_objects:  # the door may be closed
                    observation = yield from self._open_compartment(observation)
            elif target is None and scene.is_object.any():
                self._focus = find_middle(scene)
            self._focus = self._focus + self._rng.normal(0, 0.05, 2)

    def _survey(self, observation: EpisodeObservation) -> None:
        survey = self._perception.survey(list(observation.frames.values()), _TABLE)
        self._focus, self._table, self._sees_objects = survey.focus, survey.table, survey.has_objects
        if self._basket is None:  # later surveys show objects in the basket, or a part of it
            self._basket = survey.basket
        self._handle, self._is_front = survey.handle, survey.has_roof
        is_enclosed = survey.has_roof or survey.handle is not None
        self._free.set_points(survey.points if is_enclosed else np.zeros((0, 3)))
        camera_in_base = observation.frames[self._hand_camera].camera_in_base
        self._camera_in_tcp = inverse(observation.tcp_in_base) @ camera_in_base

    def _view(self, observation: EpisodeObservation, close: bool) -> Motion:
        """Move the gripper camera to a view of the focus, and return an observation with images."""
        if not self._is_front:
            try:
                observation = yield from self._arm.rise(observation, _VIEW_HEIGHT, OPEN)
            except MotionError as error:
                observation = error.observation
                _log.debug("no path up before a view")
        distances = self._settings.close_view_distances if close else self._settings.view_distances
        elevations = _FRONT_VIEWS_DEG if self._is_front else TOP_VIEWS_DEG
        for focus, of in ((self._focus, distances), (0.9 * self._focus, _FALLBACK_DISTANCES)):
            poses, costs = find_views(self._camera_in_tcp, np.array([*focus, self._table]), of, elevations)
            found = self._arm.paths.nearest(poses, costs, observation.qpos, 0.3)
            chosen = self._free.choose(observation.qpos, found, lambda pair: pair[1])
            if chosen is not None:
                observation = yield from self._arm.follow(observation, chosen[1], OPEN, COARSE)
                break
        return (yield from self._arm.request_images(observation, OPEN))

    # Decisions

    def _is_in_basket(self, one: ObservedObject) -> bool:
        return self._basket is not None and bool(np.linalg.norm(one.center[:2] - self._basket[:2]) < _IN_BASKET)

    def _plan_grasp(
        self, scene: ObservedScene, one: ObservedObject, observation: EpisodeObservation
    ) -> Keyframe | None:
        """Return the reachable grasp of an object that the grasp network prefers, or None."""
        settings = self._settings
        proposals = propose_grasps(
            scene.points, one.mask, self._table, settings.proposals, self._rng, from_front=self._is_front
        )
        paths, qpos = self._arm.paths, observation.qpos
        proposals = proposals.select(paths.is_grasp_in_reach(proposals.tcp_in_base, qpos))
        if not len(proposals.heuristic):
            return None
        best = np.argsort(-proposals.heuristic, kind="stable")[: settings.scored]
        proposals = proposals.select(best)
        grasps = proposals.tcp_in_base
        scores = self._perception.score_grasps(scene, one.mask, grasps, self._table) + 0.02 * proposals.heuristic
        for failed in self._failed:
            scores -= _FAILURE_PENALTY * compute_similarity(grasps, failed)
        if self._is_front:
            approaches = plan_front_approaches(
                paths, grasps, scores, qpos, self._front, partial(self._free.is_clear, start=0)
            )
            found = self._free.choose(qpos, approaches, lambda approach: approach.start)
            return None if found is None else Keyframe(scene, one, *found)
        approach = paths.plan_approach(grasps, scores, qpos)
        return None if approach is None else Keyframe(scene, one, approach)

    def _choose_obstacle(
        self, scene: ObservedScene, target: ObservedObject | None, observation: EpisodeObservation
    ) -> Keyframe | None:
        """Return the grasp of the object to move aside, or None."""
        objects = [one for one in scene.objects if not self._is_in_basket(one)]
        if not objects:
            return None
        if target is None:
            scores = score_height(scene, objects)
        else:
            objects = [one for one in objects if (one.mask & target.mask).sum() < 0.5 * one.mask.sum()]
            count = self._settings.proposals // 3
            grasps = propose_colliding_grasps(scene.points[target.mask], self._table, count, self._rng).tcp_in_base
            scores = score_blocking(scene, objects, target, grasps)
        for index in np.argsort(scores)[::-1][:_MAX_OBSTACLES].tolist():
            chosen = self._plan_grasp(scene, objects[index], observation)
            if chosen is not None:
                return chosen
        return None

    # Execution of keyframes

    def _open_compartment(self, observation: EpisodeObservation) -> Motion:
        """Pull the handle until the door or drawer is open; then survey the scene again."""
        arm = self._arm
        while self._handle is not None and np.linalg.norm(self._handle.motion) > _MIN_PULL and self._pulls < _MAX_PULLS:
            handle, self._handle = self._handle, None
            self._pulls += 1
            pulls = arm.paths.plan_pulls(handle, observation.qpos)
            found = self._free.choose(observation.qpos, pulls, lambda pull: pull.start)
            if found is None:
                _log.debug("no path to the handle")
                break
            pull, path = found
            self._front = self._front or Front.from_handle(handle)
            observation = yield from arm.follow(observation, path, OPEN, _NEAR_START)
            observation = yield from arm.follow(observation, pull.path, OPEN)
            observation = yield from arm.wait(observation, CLOSED)
            observation = yield from arm.follow(observation, pull.pull, CLOSED, COARSE, _PULL_SPEED)
            observation = yield from arm.wait(observation, OPEN)
            away = arm.paths.retreat(observation.qpos)  # from the actual pose, so that the bar is not dragged back
            if away is not None:
                observation = yield from arm.follow(observation, away, OPEN, COARSE, _PULL_SPEED)
            observation = yield from arm.request_images(observation, OPEN)
            self._survey(observation)
        return observation

    def _grasp(
        self, observation: EpisodeObservation, chosen: Keyframe
    ) -> Generator[Command, EpisodeObservation, tuple[EpisodeObservation, bool]]:
        """Grasp and lift; return the last observation, and whether the gripper holds something."""
        approach, arm, holds = chosen.approach, self._arm, False
        try:
            if approach.way_back is None or chosen.path is None:
                observation = yield from arm.rise(observation, chosen.safe_height, OPEN)
                observation = yield from arm.move_joints(observation, approach.start, OPEN, _NEAR_START)
                observation = yield from arm.move_straight(observation, approach.grasp, OPEN)
                observation = yield from arm.wait(observation, CLOSED)
                observation = yield from arm.rise(observation, float(observation.tcp_in_base[2, 3]) + LIFT, CLOSED)
            else:
                observation = yield from arm.follow(observation, chosen.path, OPEN, _NEAR_START)
                observation = yield from arm.follow_or_return(observation, approach.path, OPEN)
                observation = yield from arm.wait(observation, CLOSED)
                observation, is_out = yield from self._leave(observation, approach.way_back)
                if not is_out:
                    _log.debug("stopped on the way out with an object")
                    raise MotionError(observation)
            holds = observation.width >= _EMPTY
        except MotionError as error:
            observation = error.observation
            _log.debug("no path to or from a grasp")
        if not holds:
            self._failed.append(approach.grasp)
        return observation, holds

    def _leave(
        self, observation: EpisodeObservation, way_back: Array
    ) -> Generator[Command, EpisodeObservation, tuple[EpisodeObservation, bool]]:
        """Leave a compartment with the grasped object; release the object at its place if the arm is stopped.

        Returns the last observation, and whether the arm was not stopped.
        """
        arm = self._arm
        try:
            return (yield from arm.follow_or_return(observation, way_back, CLOSED, speed=_COMPARTMENT_SPEED)), True
        except MotionError as error:
            return (yield from self._release_and_leave(error.observation, way_back)), False

    def _release_and_leave(self, observation: EpisodeObservation, way_back: Array) -> Motion:
        """Open the gripper in a compartment, and leave it from the present place on."""
        observation = yield from self._arm.wait(observation, OPEN)
        nearest, _ = self._arm.find_nearest(observation, way_back)
        return (yield from self._arm.follow(observation, way_back[nearest:], OPEN))

    def _move(
        self,
        observation: EpisodeObservation,
        chosen: Keyframe,
        transfer: Callable[[EpisodeObservation, Keyframe], Motion],
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
            self._failed.append(approach.grasp)
            if approach.way_back is None:
                with suppress(MotionError):
                    observation = yield from self._arm.move_straight(observation, approach.grasp, CLOSED)
            else:
                way_in = approach.way_back[::-1]
                observation = yield from self._arm.follow(observation, way_in, CLOSED, speed=_COMPARTMENT_SPEED)
                return (yield from self._release_and_leave(observation, approach.way_back))
        return (yield from self._arm.wait(observation, OPEN))

    def _carry(self, observation: EpisodeObservation, chosen: Keyframe) -> Motion:
        """Carry the held object over the basket."""
        if self._basket is None:
            raise MotionError(observation)
        upright = chosen.approach.grasp[2, :3] if self._is_front else None
        point = self._basket + [0, 0, _RELEASE_CLEARANCE + chosen.hanging]
        found = self._arm.paths.nearest(*find_release_poses(point, upright), observation.qpos, 0.5)
        if self._is_front:  # the object may come from below the rim
            found = self._find_lowering(point, upright, observation.qpos) or found
        height = float(self._basket[2]) + max(_CARRY_CLEARANCE, _RELEASE_CLEARANCE + chosen.hanging)
        height = height if self._is_front else max(chosen.safe_height, height)
        if not found:
            raise MotionError(observation)
        try:
            observation = yield from self._arm.rise(observation, height, CLOSED)
        except MotionError as error:
            if not self._is_front:
                raise
            observation = error.observation
        points, speed = chosen.scene.points[chosen.object.mask], _COMPARTMENT_SPEED if self._is_front else 1.0
        for by_rest in (False, True) if self._is_front else (False,):  # the rest pose may be close to a table
            self._free.hold(points, chosen.approach.grasp)
            way = self._free.choose(observation.qpos, found, lambda pair: pair[1], by_rest=by_rest)
            self._free.release()
            if way is None or observation.width < _EMPTY:
                break
            (index, _), path = way
            found = [pair for pair in found if pair[0] != index]
            try:
                observation = yield from self._arm.follow_or_return(observation, path, CLOSED, COARSE, speed)
            except MotionError as error:
                observation = error.observation
                _log.debug("stopped on the way to the basket")
                continue
            if self._is_front:
                release = observation.tcp_in_base.copy()
                release[2, 3] = min(release[2, 3], point[2])
                with suppress(MotionError):
                    observation = yield from self._arm.move_straight(observation, release, CLOSED)
            return observation
        raise MotionError(observation)

    def _find_lowering(self, point: Array, upright: Array | None, qpos: Array) -> list[tuple[int, Array]]:
        """Return poses above the release point from which the TCP can be lowered to it, as `ArmPaths.nearest`."""
        poses, costs = find_release_poses(point + [0, 0, _LOWERED], upright)
        found = []
        for index, above in self._arm.paths.nearest(poses, costs, qpos, 0.5):
            release = poses[index].copy()
            release[2, 3] -= _LOWERED
            if self._arm.paths.straight(above, release, sequential=False) is not None:
                found.append((index, above))
            if len(found) == _LOWERINGS:
                break
        return found

    def _place(self, observation: EpisodeObservation, chosen: Keyframe) -> Motion:
        """Place the held object at a free place of the surface."""
        poses, costs = [], []
        avoid = [(self._focus, _TARGET_GAP)]
        if self._basket is not None:
            avoid.append((self._basket[:2], _BASKET_GAP))
        for place in self._map.find_free_places(self._table, observation.tcp_in_base[:2, 3], avoid):
            for turn in np.arange(-np.pi, np.pi, np.pi / 4):
                rotation = Rotation.from_euler("z", turn).as_matrix() @ chosen.approach.grasp[:3, :3]
                poses.append(from_rotation([*place, self._table + chosen.hanging + _DROP], rotation))
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
