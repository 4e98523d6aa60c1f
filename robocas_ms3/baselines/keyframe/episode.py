"""One episode of `keyframe`: look, choose the next keyframe, execute it, and look again."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.config import DecisionSettings
from robocas_ms3.baselines.keyframe.grasp_proposals import propose_colliding_grasps, propose_grasps
from robocas_ms3.baselines.keyframe.motion import LIFT, Approach, ArmPaths, PathFollower, find_looks
from robocas_ms3.baselines.keyframe.observed_scene import HeightMap, ObservedObject, ObservedScene
from robocas_ms3.baselines.keyframe.perception import CameraFrame, Perception, Request
from robocas_ms3.core.poses import Array, from_rotation, inverse
from robocas_ms3.scenes.grasp_checks import is_gripper_clear
from robocas_ms3.scenes.relations import select_by_relation

OPEN, CLOSED = 1.0, 0.0
"""Gripper commands of the convention ``robocas``."""
_TABLE = 0.12  # m, height of a table in the arm's base frame if it is not seen
_SAFE_HEIGHT = (0.35, 0.55)  # m, least and greatest height of the TCP for motions above objects
_CLEARANCE = 0.12  # m between the TCP and the highest object near a grasp
_LOOK_HEIGHT = 0.4  # m of the TCP before a look
_EMPTY = 0.003  # m, gripper width below which nothing is held
_WAIT = 4  # control steps of 0.2 s in which the gripper closes or opens
_PRECISE, _COARSE = (0.004, 0.03), (0.02, 0.1)  # m and rad from the goal at which a motion ends
_PATIENCE = 5  # policy steps without progress, after which a motion ends
_REPEAT_DISTANCE = 0.02  # m around a failed grasp in which similar grasps lose score
_FREE_CELLS = (11, 7)  # sizes of free squares in cells of 2 cm, the preferred one first
_SPOT_DISTANCES = (0.35, 0.8)  # m from the base, least and greatest distance of a place for an obstacle
_TARGET_GAP, _BASKET_GAP = 0.16, 0.28  # m between such a place and the target, and the basket
_RELEASE_TILTS, _RELEASE_SIDES = (0, 15, 30, 45, 60, 72), (0.0, -0.4, 0.4)  # degrees; rad about the vertical
_MAX_OBSTACLES = 5  # obstacles for which grasps are computed per decision


@dataclass(frozen=True)
class RobotView:
    """Observation of one env.

    Attributes:
        tcp_in_base: (4, 4) TCP pose in the arm's base frame.
        qpos: (7,) joint angles of the arm, rad.
        width: gripper width, m.
        frames: images by camera name; empty if none were requested.
    """

    tcp_in_base: Array
    qpos: Array
    width: float
    frames: dict[str, CameraFrame]


@dataclass(frozen=True)
class Command:
    """Command of one policy step.

    Attributes:
        action: (7,) action of the convention ``robocas``, relative to the present TCP pose.
        requests_images: whether the next observation needs images.
    """

    action: Array
    requests_images: bool = False


Motion = Generator[Command, RobotView, RobotView]
"""Generator that yields commands, receives observations, and returns the last observation."""


class MotionError(Exception):
    """The arm has no path for a motion."""


@dataclass
class _Keyframe:
    """A grasp that was chosen: the object, the scene and the approach."""

    scene: ObservedScene
    object: ObservedObject
    approach: Approach
    value: float

    @property
    def hanging(self) -> float:
        """Distance in m from the TCP down to the lowest visible point of the object."""
        return max(0.015, float(self.approach.grasp[2, 3] - self.scene.points[self.object.mask][:, 2].min()))

    @property
    def safe_height(self) -> float:
        points = self.scene.points
        near = points[np.linalg.norm(points[:, :2] - self.approach.grasp[:2, 3], axis=1) < 0.35]
        return float(np.clip(near[:, 2].max() + _CLEARANCE, *_SAFE_HEIGHT))


class KeyframeEpisode:
    """Decisions and motions of one episode.

    Args:
        perception: networks.
        paths: kinematics of the arm.
        settings: settings of the decisions.
        request: what the instruction asks for.
        rng: random generator of the proposals.
        control_steps: control steps of 0.2 s per policy step.
        hand_camera: name of the camera on the hand.

    Attributes:
        log: decisions in words, for diagnosis.
    """

    def __init__(
        self,
        perception: Perception,
        paths: ArmPaths,
        settings: DecisionSettings,
        request: Request,
        rng: np.random.Generator,
        *,
        control_steps: int,
        hand_camera: str,
    ) -> None:
        self._perception, self._paths, self._settings = perception, paths, settings
        self._request, self._rng, self._control_steps, self._hand_camera = request, rng, control_steps, hand_camera
        self._failed: list[Array] = []  # TCP poses of failed grasps
        self._map = HeightMap()
        self._table, self._focus = _TABLE, np.array([0.6, 0.0])
        self._basket: Array | None = None
        self._camera_in_tcp = np.eye(4)
        self.log: list[str] = []

    def run(self, view: RobotView) -> Motion:
        """Run the episode from its first observation, which has images, until it ends."""
        self._survey(view)
        close = False
        while True:
            view = yield from self._look(view, close)
            scene = self._perception.observe(view.frames[self._hand_camera], self._request, self._table)
            self._map.update(scene.points)
            target = self._choose_target(scene)
            chosen = None if target is None else self._plan_grasp(scene, target, view)
            if target is not None:
                self._focus = scene.points[target.mask].mean(axis=0)[:2]
            if chosen is not None:
                view = yield from self._move_to_basket(view, chosen)
                close = False
                continue
            chosen = self._choose_obstacle(scene, target, view)
            if chosen is not None:
                view = yield from self._move_aside(view, chosen)
                close = False
                continue
            self.log.append(f"no keyframe; target {'seen' if target else 'not seen'}")
            close = not close
            middle = self._focus if target is not None or not scene.is_object.any() else _middle(scene)
            self._focus = middle + self._rng.normal(0, 0.05, 2)

    def _survey(self, view: RobotView) -> None:
        survey = self._perception.survey(list(view.frames.values()), _TABLE)
        self._focus, self._basket, self._table = survey.focus, survey.basket, survey.table
        self._camera_in_tcp = inverse(view.tcp_in_base) @ view.frames[self._hand_camera].camera_in_base
        seen = "not seen" if self._basket is None else f"at {np.round(self._basket, 2).tolist()}"
        self.log.append(f"objects around {np.round(self._focus, 2).tolist()}, basket {seen}")

    # Decisions

    def _choose_target(self, scene: ObservedScene) -> ObservedObject | None:
        found = [one for one in scene.targets if not self._is_in_basket(one)]
        if not found:
            return None
        sure = [one for one in found if one.probability > 0.6] or found
        xy = np.stack([one.center[:2] for one in sure])
        index = select_by_relation(self._request.relation, xy) if self._request.relation else None
        if index is None:  # no relation, or it does not tell: the nearest one is meant
            index = int(np.linalg.norm(xy, axis=1).argmin())
        return sure[index]

    def _is_in_basket(self, one: ObservedObject) -> bool:
        return self._basket is not None and bool(np.linalg.norm(one.center[:2] - self._basket[:2]) < 0.14)

    def _plan_grasp(self, scene: ObservedScene, one: ObservedObject, view: RobotView) -> _Keyframe | None:
        settings = self._settings
        proposals = propose_grasps(scene.points, one.mask, self._table, settings.proposals, self._rng)
        if not len(proposals.heuristic):
            return None
        best = np.argsort(-proposals.heuristic, kind="stable")[: settings.scored]
        proposals = proposals.select(best)
        grasps = proposals.tcp_in_base
        values = self._perception.score_grasps(scene, one.mask, grasps, self._table)
        scores = values + 0.02 * proposals.heuristic
        for failed in self._failed:
            near = np.exp(-((np.linalg.norm(grasps[:, :3, 3] - failed[:3, 3], axis=1) / _REPEAT_DISTANCE) ** 2))
            similar = np.einsum("gij,ij->g", grasps[:, :3, :3], failed[:3, :3]) > 2.6  # trace; 3: equal rotations
            scores -= 2 * near * similar
        planned = self._paths.plan_approach(grasps, scores, view.qpos)
        return None if planned is None else _Keyframe(scene, one, planned[1], float(values[planned[0]]))

    def _choose_obstacle(
        self, scene: ObservedScene, target: ObservedObject | None, view: RobotView
    ) -> _Keyframe | None:
        """Choose the object to move aside: it blocks grasps of the target, or is on top if the target is not seen."""
        objects = [one for one in scene.objects if not self._is_in_basket(one)]
        if target is not None:
            objects = [one for one in objects if (one.mask & target.mask).sum() < 0.5 * one.mask.sum()]
            goal = scene.points[target.mask]
            grasps = propose_colliding_grasps(goal, self._table, self._settings.proposals // 3, self._rng).tcp_in_base
        scores = []
        for one in objects:
            points = scene.points[one.mask]
            top = float(np.percentile(points[:, 2], 95))
            if target is None:
                scores.append(6 * top - float(np.linalg.norm(points.mean(axis=0)[:2] - _middle(scene))))
                continue
            blocked = 1 - is_gripper_clear(grasps, points).mean() if len(grasps) else 0.0
            gap = float(np.linalg.norm(points[:, :2] - goal.mean(axis=0)[:2], axis=1).min())
            scores.append(1.5 * blocked - 5 * gap + 4 * (top - goal[:, 2].max()))
        for index in np.argsort(scores)[::-1][:_MAX_OBSTACLES].tolist():
            chosen = self._plan_grasp(scene, objects[index], view)
            if chosen is not None:
                return chosen
        return None

    # Motions of keyframes

    def _look(self, view: RobotView, close: bool) -> Motion:
        view = yield from self._rise(view, _LOOK_HEIGHT, OPEN, required=False)
        distances = self._settings.close_look_distances if close else self._settings.look_distances
        found: list = []
        for point, of in (
            (np.array([*self._focus, self._table]), distances),
            (np.array([*0.9 * self._focus, self._table]), (0.3, 0.35, 0.4, 0.45, 0.25)),
        ):
            poses, costs = find_looks(self._camera_in_tcp, point, of)
            found = found or self._paths.nearest(poses, costs, view.qpos, 0.3)
        if found:
            view = yield from self._follow(view, self._paths.joint(view.qpos, found[0][1]), OPEN, _COARSE)
        return (yield Command(_make_action(view, view.tcp_in_base, OPEN), requests_images=True))

    def _grasp(self, view: RobotView, chosen: _Keyframe) -> Generator[Command, RobotView, tuple[RobotView, bool]]:
        """Grasp and lift; return the last observation, and whether the gripper holds something."""
        approach = chosen.approach
        try:
            view = yield from self._rise(view, chosen.safe_height, OPEN)
            view = yield from self._follow(view, self._paths.joint(view.qpos, approach.start), OPEN, (0.008, 0.05))
            view = yield from self._straight(view, approach.grasp, OPEN)
            view = yield from self._wait(view, CLOSED)
            view = yield from self._rise(view, float(view.tcp_in_base[2, 3]) + LIFT, CLOSED)
        except MotionError:
            self._failed.append(approach.grasp)
            return view, False
        holds = view.width >= _EMPTY
        if not holds:
            self._failed.append(approach.grasp)
        return view, holds

    def _move_to_basket(self, view: RobotView, chosen: _Keyframe) -> Motion:
        self.log.append(
            f"grasp target at {np.round(chosen.approach.grasp[:3, 3], 3).tolist()}, value {chosen.value:.2f}"
        )
        view, holds = yield from self._grasp(view, chosen)
        if not holds:
            self.log.append("empty")
            return view
        try:
            view = yield from self._carry(view, min(chosen.hanging, 0.16), chosen.safe_height)
        except MotionError:
            self.log.append("no path to the basket")
        return (yield from self._wait(view, OPEN))

    def _move_aside(self, view: RobotView, chosen: _Keyframe) -> Motion:
        self.log.append(f"move aside at {np.round(chosen.approach.grasp[:3, 3], 3).tolist()}, value {chosen.value:.2f}")
        view, holds = yield from self._grasp(view, chosen)
        if not holds:
            self.log.append("empty")
            return view
        try:
            view = yield from self._place(view, chosen)
        except MotionError:
            self.log.append("no path to a free place")
        return (yield from self._wait(view, OPEN))

    def _carry(self, view: RobotView, hanging: float, safe_height: float) -> Motion:
        """Carry the held object over the basket."""
        if self._basket is None:
            raise MotionError
        rim = float(self._basket[2])
        azimuth = float(np.arctan2(self._basket[1], self._basket[0]))
        away = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        poses, costs = [], []
        for tilt in np.deg2rad(_RELEASE_TILTS):
            for side in _RELEASE_SIDES:
                level = np.array([np.cos(azimuth + side), np.sin(azimuth + side), 0.0])
                approach = np.sin(tilt) * level - np.array([0, 0, np.cos(tilt)])
                for turn in np.arange(0, 2 * np.pi, np.pi / 6):
                    closing = np.array([np.cos(turn), np.sin(turn), 0.0])
                    closing -= approach * (approach @ closing)
                    if np.linalg.norm(closing) < 0.2:
                        continue
                    closing /= np.linalg.norm(closing)
                    rotation = np.stack([np.cross(closing, approach), closing, approach], axis=1)
                    for nearer in (0.0, 0.05):
                        position = np.array([*self._basket[:2], rim + 0.03 + hanging]) - nearer * away
                        poses.append(from_rotation(position, rotation))
                        costs.append(0.01 * np.rad2deg(tilt) + 4 * nearer)
        found = self._paths.nearest(np.array(poses), np.array(costs), view.qpos, 0.5)
        if not found:
            raise MotionError
        view = yield from self._rise(view, max(safe_height, rim + 0.15), CLOSED)
        return (yield from self._follow(view, self._paths.joint(view.qpos, found[0][1]), CLOSED, _COARSE))

    def _place(self, view: RobotView, chosen: _Keyframe) -> Motion:
        """Place the held object at a free place of the surface."""
        spots = self._find_spots(view)
        poses, costs = [], []
        for spot in spots:
            for turn in np.arange(-np.pi, np.pi, np.pi / 4):
                rotation = Rotation.from_euler("z", turn).as_matrix() @ chosen.approach.grasp[:3, :3]
                poses.append(from_rotation([*spot, self._table + chosen.hanging + 0.02], rotation))
                costs.append(2 * float(np.linalg.norm(spot - view.tcp_in_base[:2, 3])))
        if not poses:
            raise MotionError
        above = np.array(poses)
        above[:, 2, 3] += LIFT
        for index, qpos in self._paths.nearest(above, np.array(costs), view.qpos, 0.5)[:10]:
            if self._paths.straight(qpos, poses[index]) is None:
                continue
            view = yield from self._rise(view, max(chosen.safe_height, 0.38), CLOSED)
            view = yield from self._follow(view, self._paths.joint(view.qpos, qpos), CLOSED, _COARSE)
            return (yield from self._straight(view, poses[index], CLOSED))
        raise MotionError

    def _find_spots(self, view: RobotView) -> Array:
        for cells in _FREE_CELLS:
            spots = self._map.find_free_squares(self._table, cells)
            distance = np.linalg.norm(spots, axis=1)
            fits = (distance > _SPOT_DISTANCES[0]) & (distance < _SPOT_DISTANCES[1])
            fits &= np.linalg.norm(spots - self._focus, axis=1) > _TARGET_GAP
            if self._basket is not None:
                fits &= np.linalg.norm(spots - self._basket[:2], axis=1) > _BASKET_GAP
            if fits.any():
                spots = spots[fits]
                order = np.argsort(np.linalg.norm(spots - view.tcp_in_base[:2, 3], axis=1), kind="stable")
                return spots[order[:40:2]]
        return np.zeros((0, 2))

    # Motions

    def _follow(
        self, view: RobotView, path: Array, gripper: float, tolerance: tuple[float, float] = _PRECISE
    ) -> Motion:
        follower, index, waited = PathFollower(self._paths.chain, path, self._control_steps), -1, 0
        while waited < _PATIENCE:  # steps without progress: the arm has nearly arrived, or is blocked
            pose = follower.next_pose(view.tcp_in_base)
            view = yield Command(_make_action(view, pose, gripper))
            error = inverse(view.tcp_in_base) @ follower.goal
            turn = Rotation.from_matrix(error[:3, :3]).magnitude()
            if follower.is_last and np.linalg.norm(error[:3, 3]) < tolerance[0] and turn < tolerance[1]:
                break
            waited = 0 if follower.index > index else waited + 1
            index = follower.index
        return view

    def _straight(self, view: RobotView, tcp_in_base: Array, gripper: float) -> Motion:
        path = self._paths.straight(view.qpos, tcp_in_base)
        if path is None:
            raise MotionError
        return (yield from self._follow(view, path, gripper))

    def _rise(self, view: RobotView, height: float, gripper: float, *, required: bool = True) -> Motion:
        if view.tcp_in_base[2, 3] >= height - 0.01:
            return view
        path = self._paths.rise(view.qpos, view.tcp_in_base, height)
        if path is None:
            if required:
                raise MotionError
            return view
        return (yield from self._follow(view, path, gripper, _COARSE))

    def _wait(self, view: RobotView, gripper: float) -> Motion:
        for _ in range(-(-_WAIT // self._control_steps)):
            view = yield Command(_make_action(view, view.tcp_in_base, gripper))
        return view


def _make_action(view: RobotView, tcp_in_base: Array, gripper: float) -> Array:
    """Return the action (7,) that moves the TCP to a pose (4, 4)."""
    motion = inverse(view.tcp_in_base) @ tcp_in_base
    return np.array([*motion[:3, 3], *Rotation.from_matrix(motion[:3, :3]).as_euler("xyz"), gripper])


def _middle(scene: ObservedScene) -> Array:
    """Return the middle (2,) of all objects, m."""
    return np.median(scene.points[scene.is_object][:, :2], axis=0)
