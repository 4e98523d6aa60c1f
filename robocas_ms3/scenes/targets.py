"""Choose the target among settled objects, by the rule of the task. No simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.annotations import GRIPPER_RADIUS
from robocas_ms3.assets.pack import LoadedObject
from robocas_ms3.core.extensions import import_object
from robocas_ms3.core.poses import transform_points
from robocas_ms3.scenes.grasp_checks import PREGRASP_DISTANCE, has_free_grasps
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array
from robocas_ms3.scenes.relations import select_by_relation
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.scenes.visibility import MeshScene, PinholeCamera, load_visual_mesh, top_down_camera


@dataclass(frozen=True)
class TargetChoice:
    """The chosen target.

    Attributes:
        slot: index of the target's slot.
        relation: relation that distinguishes the target from objects of the same name; empty: no relation.
        visible_fractions: (K,) visible fraction of each object; empty if the rule does not use it.
    """

    slot: int
    relation: str = ""
    visible_fractions: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class SettledScene:
    """Settled objects, from which a target is chosen. K slots; poses (4, 4) in the world frame, m.

    Attributes:
        model: configuration and assets.
        assets: objects of the K slots.
        poses: (K, 4, 4) poses of the objects.
        present: (K,) bool, whether each slot is used.
        candidate: (K,) bool, whether each object may be the target: it is present and not a distractor.
        robot_pose: pose of the robot's root.
        basket_pose: pose of the basket; None if the scene has none.
    """

    model: SceneModel
    assets: list[LoadedObject]
    poses: Array
    present: NDArray[np.bool_]
    candidate: NDArray[np.bool_]
    robot_pose: Array
    basket_pose: Array | None

    @property
    def names(self) -> list[str]:
        return [asset.asset.name for asset in self.assets]

    @cached_property
    def opened_poses(self) -> Array:
        """(K, 4, 4) poses of the objects after the door or drawer of the task has been opened."""
        frame = self.model.support_pose
        before, after = (self.model.support_motion(opened=opened) for opened in (False, True))
        moved = frame @ after @ np.linalg.inv(frame @ before)
        return np.where(self.present[:, None, None], moved @ self.poses, self.poses)

    @property
    def xy_in_robot(self) -> Array:
        """(K, 2) positions of the objects in the robot's frame after opening, m: x forward, y left."""
        return (np.linalg.inv(self.robot_pose) @ self.opened_poses)[:, :2, 3]

    @property
    def is_eligible(self) -> NDArray[np.bool_]:
        """(K,) bool, whether each object is a candidate with enough grasps, near enough to the robot."""
        rules = self.model.config.target
        near = np.linalg.norm(self.xy_in_robot, axis=1) <= rules.max_distance
        graspable = np.array([asset.asset.grasp_count >= rules.min_grasps for asset in self.assets])
        return self.candidate & near & graspable

    @cached_property
    def fixture_points(self) -> Array:
        """(P, 3) points on the surfaces of opened furniture and basket, world frame, m."""
        return self.model.fixture_points(self.basket_pose, opened=True)

    def has_free_grasps(self, slot: int) -> bool:
        """Return whether an object has ``target.min_free_grasps`` collision-free grasps."""
        others = [
            transform_points(self.opened_poses[other], self.assets[other].surface_points())
            for other in np.flatnonzero(self.present)
            if other != slot and self._within_reach(slot, other)
        ]
        return self._has_grasps(slot, others, self.model.config.target.min_free_grasps)

    def has_uncovered_grasps(self, slot: int) -> bool:
        """Return whether an object would have enough collision-free grasps without the other objects.

        The configuration has the number, ``target.min_uncovered_grasps``.
        """
        return self._has_grasps(slot, [], self.model.config.target.min_uncovered_grasps)

    def _has_grasps(self, slot: int, others: list[Array], min_count: int) -> bool:
        return has_free_grasps(
            self.assets[slot],
            self.opened_poses[slot],
            np.concatenate([self.fixture_points, *others]),
            self.robot_pose[:2, 3],
            self.model.config.target.approach,
            min_count=min_count,
        )

    def _within_reach(self, slot: int, other: int) -> bool:
        """Return whether the object ``other`` is near enough to block grasps of the object ``slot``."""
        centers = self.opened_poses[[slot, other], :3, 3]
        radius = np.linalg.norm(np.concatenate(self.assets[other].hulls), axis=1).max()
        grasps = self.assets[slot].annotations.grasps_tcp_in_object[:, :3, 3]
        reach = np.linalg.norm(grasps, axis=1).max() + GRIPPER_RADIUS + PREGRASP_DISTANCE
        return bool(np.linalg.norm(centers[1] - centers[0]) <= radius + reach)


@dataclass(frozen=True)
class TargetRule:
    """A rule that chooses the target.

    Attributes:
        choose: function of a random generator and a `SettledScene` that returns a `TargetChoice`, or None if no object
            qualifies.
        keys: keys of ``target`` in a configuration that should be lowered if no object qualifies.
    """

    choose: Callable[[np.random.Generator, SettledScene], TargetChoice | None]
    keys: tuple[str, ...] = ("min_grasps",)


def find_target_rule(task: str) -> TargetRule:
    return import_object(TASKS[task].target)


def choose_target(rng: np.random.Generator, scene: SettledScene) -> TargetChoice | None:
    return find_target_rule(scene.model.config.task).choose(rng, scene)


def _choose_by_name(rng: np.random.Generator, scene: SettledScene) -> TargetChoice | None:
    """Choose any object.

    If several objects have the same name, only the nearest of them may be the target.
    """
    nearest: dict[str, int] = {}
    for slot in np.argsort(np.linalg.norm(scene.xy_in_robot, axis=1), kind="stable"):
        if scene.present[slot]:
            nearest.setdefault(scene.names[slot], int(slot))
    slots = sorted(slot for slot in nearest.values() if scene.is_eligible[slot])
    shuffled = rng.permutation(np.array(slots, dtype=int)).tolist()
    return next((TargetChoice(slot) for slot in shuffled if scene.has_free_grasps(slot)), None)


def _choose_by_relation(rng: np.random.Generator, scene: SettledScene) -> TargetChoice | None:
    """Choose an object and a relation that distinguishes it from identical objects.

    If ``target.relations`` is empty, choose like `_choose_by_name`.
    """
    if not scene.model.config.target.relations:
        return _choose_by_name(rng, scene)
    pairs = [(name, relation) for name in sorted(set(scene.names)) for relation in scene.model.config.target.relations]
    for index in rng.permutation(len(pairs)):
        name, relation = pairs[index]
        slots = [s for s, n in enumerate(scene.names) if n == name and scene.present[s]]
        found = select_by_relation(relation, scene.xy_in_robot[slots])
        if found is not None and scene.is_eligible[slots[found]] and scene.has_free_grasps(slots[found]):
            return TargetChoice(slots[found], relation)
    return None


def selection_camera(model: SceneModel) -> PinholeCamera:
    """Return the camera that measures visible fractions, above the middle of the objects' region."""
    region = model.region
    middle = np.append(np.add(region.min_xy, region.max_xy) / 2, region.z)
    center = transform_points(model.support_pose, middle[None])[0]
    return top_down_camera(center[:2], center[2])


def _choose_by_visibility(rng: np.random.Generator, scene: SettledScene) -> TargetChoice | None:
    """Choose an object with a small visible fraction.

    The probability of an object is proportional to 1 / distance to the robot.

    RoboCAS-v0's data has this rule. An object does not qualify if furniture or basket block its grasps, even without
    the other objects. Example: a flat can that lies on its flat side.
    """
    rules = scene.model.config.target
    slots = np.flatnonzero(scene.present)
    fractions = np.full(len(scene.assets), np.nan)
    scenery = MeshScene([load_visual_mesh(scene.assets[s]) for s in slots], scene.poses[slots])
    fractions[slots] = scenery.visible_fractions(selection_camera(scene.model))
    unique = np.array([scene.names.count(name) == 1 for name in scene.names])
    fits = scene.is_eligible & unique
    if rules.max_visible_share is not None:
        fits &= fractions < rules.max_visible_share
    likely = 1 / np.linalg.norm(scene.xy_in_robot, axis=1) if rules.weight == "nearness" else np.ones(len(fits))
    weight = np.where(fits, likely, 0)
    while weight.any():
        slot = int(rng.choice(len(weight), p=weight / weight.sum()))
        if scene.has_uncovered_grasps(slot) and (rules.min_free_grasps == 0 or scene.has_free_grasps(slot)):
            return TargetChoice(slot, visible_fractions=fractions)
        weight[slot] = 0
    return None


BY_NAME = TargetRule(_choose_by_name)
BY_RELATION = TargetRule(_choose_by_relation)
BY_VISIBILITY = TargetRule(_choose_by_visibility, ("min_grasps", "min_uncovered_grasps"))
