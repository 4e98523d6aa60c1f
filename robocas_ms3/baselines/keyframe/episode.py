"""One episode of `keyframe`: view the scene, choose the next keyframe, execute it, and repeat."""

from __future__ import annotations

import logging
from functools import partial

import numpy as np

from robocas_ms3.baselines.keyframe.arm_control import (
    CLOSED,
    COARSE,
    NEAR_START,
    OPEN,
    ArmControl,
    EpisodeObservation,
    Motion,
    MotionError,
)
from robocas_ms3.baselines.keyframe.chosen_grasp import ChosenGrasp
from robocas_ms3.baselines.keyframe.config import DecisionSettings
from robocas_ms3.baselines.keyframe.free_paths import FreePaths
from robocas_ms3.baselines.keyframe.front_approaches import Front, plan_front_approaches
from robocas_ms3.baselines.keyframe.grasp_proposals import compute_similarity, propose_colliding_grasps, propose_grasps
from robocas_ms3.baselines.keyframe.handles import Handle
from robocas_ms3.baselines.keyframe.object_motions import Memory, ObjectMotions
from robocas_ms3.baselines.keyframe.observed_scene import ObservedObject, ObservedScene
from robocas_ms3.baselines.keyframe.obstacles import find_middle, score_blocking, score_height
from robocas_ms3.baselines.keyframe.perception import Perception, Request
from robocas_ms3.baselines.keyframe.targets import TargetChoice
from robocas_ms3.baselines.keyframe.tcp_poses import TOP_VIEWS_DEG, find_views
from robocas_ms3.core.poses import inverse

_TABLE = 0.12  # m, height of a table in the arm's base frame if it is not seen
_VIEW_HEIGHT = 0.4  # m of the TCP before it moves to a view
_FALLBACK_DISTANCES = (0.3, 0.35, 0.4, 0.45, 0.25)  # m from the camera to a point that is nearer to the base
_FAILURE_PENALTY = 2.0  # of the score of a grasp that equals a failed one; scores are probabilities
_IN_BASKET = 0.14  # m from the middle of the basket, within which an object is in it
_SURVEY_INTERVAL = 3  # from one survey to the next, in views of a compartment without the target
_MAX_OBSTACLES = 5  # obstacles for which grasps are computed per decision
_MAX_PULLS, _PULL_SPEED = 4, 0.3  # pulls per episode; fraction of the limits
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
        self._memory = Memory(_TABLE)
        self._handle: Handle | None = None
        self._front: Front | None = None  # of a compartment that had a closed door
        self._sees_objects, self._pulls = False, 0
        self._camera_in_tcp = np.eye(4)

    def run(self, observation: EpisodeObservation) -> Motion:
        """Run the episode from its first observation, which has images, until it is ended from outside."""
        self._free = FreePaths(self._arm.paths, observation.qpos)
        motions = ObjectMotions(self._arm, self._free, self._memory)
        self._survey(observation)
        observation = yield from self._open_compartment(observation)
        close, without_target = False, 0
        while True:
            observation = yield from self._view(observation, close)
            if self._memory.basket is None:
                frames = list(observation.frames.values())
                self._memory.basket = self._perception.survey(frames, self._memory.table).basket
            scene = self._perception.observe(observation.frames[self._hand_camera], self._request, self._memory.table)
            self._memory.height_map.update(scene.points)
            target = self._targets.choose([one for one in scene.targets if not self._is_in_basket(one)])
            chosen, without_target = None, without_target + 1
            if target is not None:
                without_target = 0
                self._memory.focus = scene.points[target.mask].mean(axis=0)[:2]
                chosen = self._plan_grasp(scene, target, observation)
            if chosen is not None:
                observation = yield from motions.move(observation, chosen, motions.carry)
                close = False
                continue
            chosen = None if self._memory.is_front else self._choose_obstacle(scene, target, observation)
            if chosen is not None:
                observation = yield from motions.move(observation, chosen, motions.place)
                close = False
                continue
            _log.debug("no keyframe; the target is %s", "not seen" if target is None else "seen")
            close = not close
            if without_target % _SURVEY_INTERVAL == 1 and (self._memory.is_front or self._pulls):
                self._survey(observation)
                if not self._sees_objects:  # the door may be closed
                    observation = yield from self._open_compartment(observation)
            elif target is None and scene.is_object.any():
                self._memory.focus = find_middle(scene)
            self._memory.focus = self._memory.focus + self._rng.normal(0, 0.05, 2)

    def _survey(self, observation: EpisodeObservation) -> None:
        survey = self._perception.survey(list(observation.frames.values()), _TABLE)
        self._memory.focus, self._memory.table, self._sees_objects = survey.focus, survey.table, survey.has_objects
        if self._memory.basket is None:  # later surveys show objects in the basket, or a part of it
            self._memory.basket = survey.basket
        self._handle, self._memory.is_front = survey.handle, survey.has_roof
        is_enclosed = survey.has_roof or survey.handle is not None
        self._free.set_points(survey.points if is_enclosed else np.zeros((0, 3)))
        camera_in_base = observation.frames[self._hand_camera].camera_in_base
        self._camera_in_tcp = inverse(observation.tcp_in_base) @ camera_in_base

    def _view(self, observation: EpisodeObservation, close: bool) -> Motion:
        """Move the gripper camera to a view of the focus, and return an observation with images."""
        if not self._memory.is_front:
            try:
                observation = yield from self._arm.rise(observation, _VIEW_HEIGHT, OPEN)
            except MotionError as error:
                observation = error.observation
                _log.debug("no path up before a view")
        distances = self._settings.close_view_distances if close else self._settings.view_distances
        elevations = _FRONT_VIEWS_DEG if self._memory.is_front else TOP_VIEWS_DEG
        for focus, of in ((self._memory.focus, distances), (0.9 * self._memory.focus, _FALLBACK_DISTANCES)):
            poses, costs = find_views(self._camera_in_tcp, np.array([*focus, self._memory.table]), of, elevations)
            found = self._arm.paths.nearest(poses, costs, observation.qpos, 0.3)
            chosen = self._free.choose(observation.qpos, found, lambda pair: pair[1])
            if chosen is not None:
                observation = yield from self._arm.follow(observation, chosen[1], OPEN, COARSE)
                break
        return (yield from self._arm.request_images(observation, OPEN))

    # Decisions

    def _is_in_basket(self, one: ObservedObject) -> bool:
        return self._memory.basket is not None and bool(
            np.linalg.norm(one.center[:2] - self._memory.basket[:2]) < _IN_BASKET
        )

    def _plan_grasp(
        self, scene: ObservedScene, one: ObservedObject, observation: EpisodeObservation
    ) -> ChosenGrasp | None:
        """Return the reachable grasp of an object that the grasp network prefers, or None."""
        settings = self._settings
        proposals = propose_grasps(
            scene.points, one.mask, self._memory.table, settings.proposals, self._rng, from_front=self._memory.is_front
        )
        paths, qpos = self._arm.paths, observation.qpos
        proposals = proposals.select(paths.is_grasp_in_reach(proposals.tcp_in_base, qpos))
        if not len(proposals.heuristic):
            return None
        best = np.argsort(-proposals.heuristic, kind="stable")[: settings.scored]
        proposals = proposals.select(best)
        grasps = proposals.tcp_in_base
        scores = self._perception.score_grasps(scene, one.mask, grasps, self._memory.table) + 0.02 * proposals.heuristic
        for failed in self._memory.failed:
            scores -= _FAILURE_PENALTY * compute_similarity(grasps, failed)
        if self._memory.is_front:
            approaches = plan_front_approaches(
                paths, grasps, scores, qpos, self._front, partial(self._free.is_clear, start=0)
            )
            found = self._free.choose(qpos, approaches, lambda approach: approach.start)
            return None if found is None else ChosenGrasp(scene, one, *found)
        approach = paths.plan_approach(grasps, scores, qpos)
        return None if approach is None else ChosenGrasp(scene, one, approach)

    def _choose_obstacle(
        self, scene: ObservedScene, target: ObservedObject | None, observation: EpisodeObservation
    ) -> ChosenGrasp | None:
        """Return the grasp of the object to move aside, or None."""
        objects = [one for one in scene.objects if not self._is_in_basket(one)]
        if not objects:
            return None
        if target is None:
            scores = score_height(scene, objects)
        else:
            objects = [one for one in objects if (one.mask & target.mask).sum() < 0.5 * one.mask.sum()]
            count = self._settings.proposals // 3
            grasps = propose_colliding_grasps(
                scene.points[target.mask], self._memory.table, count, self._rng
            ).tcp_in_base
            scores = score_blocking(scene, objects, target, grasps)
        for index in np.argsort(scores)[::-1][:_MAX_OBSTACLES].tolist():
            chosen = self._plan_grasp(scene, objects[index], observation)
            if chosen is not None:
                return chosen
        return None

    def _open_compartment(self, observation: EpisodeObservation) -> Motion:
        """Pull the handle until the door or drawer is open; then survey the scene again."""
        arm = self._arm
        while self._handle is not None and self._handle.can_be_pulled and self._pulls < _MAX_PULLS:
            handle, self._handle = self._handle, None
            self._pulls += 1
            pulls = arm.paths.plan_pulls(handle, observation.qpos)
            found = self._free.choose(observation.qpos, pulls, lambda pull: pull.start)
            if found is None:
                _log.debug("no path to the handle")
                break
            pull, path = found
            self._front = self._front or Front.from_handle(handle)
            observation = yield from arm.follow(observation, path, OPEN, NEAR_START)
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
