"""Measure a scene before and after a candidate: poses, clutter around each object, and free grasps of each object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.arrays import as_tensor, to_native
from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.remove import count_clear_grasps
from robocas_ms3.scenes.grasp_checks import NEIGHBOURHOOD
from robocas_ms3.scenes.targets import selection_camera
from robocas_ms3.tasks import occlusion
from robocas_ms3.tasks.open_pick import RoboCASOpenPickEnv

DISTURBED = 0.02  # m, displacement from which another object counts as disturbed
_UNCHANGED = 0.002  # m and quaternion components, motion of an object that has no effect on free grasps
_REACH = NEIGHBOURHOOD / 2  # m between an object and another one that may block its grasps
Array = NDArray[Any]


@dataclass(frozen=True)
class SceneMeasures:
    """Measures of a scene with K object slots.

    Attributes:
        object_in_base: (K, 7) float64 poses in the arm's base frame; NaN in empty slots.
        hidden_fraction: (K,) fraction of each object that other objects hide, seen from above.
        obstacles: (K,) int, number of obstacles around each object.
        free_grasps: (K,) int, number of annotated grasps of each object whose gripper touches no other body.
        fallen: (K,) bool, whether each object has fallen off the surface, except into the basket.
        in_basket: (K,) bool, whether each object is in the basket.
        held: (K,) bool, whether both fingers hold each object.
        opening: opening of the door or drawer as a fraction of its range; NaN without one.
    """

    object_in_base: Array
    hidden_fraction: Array
    obstacles: Array
    free_grasps: Array
    fallen: Array
    in_basket: Array
    held: Array
    opening: float


def measure_scene(arm: Arm, before: SceneMeasures | None = None) -> SceneMeasures:
    """Measure the present scene.

    Args:
        arm: context of the attempt.
        before: earlier measures of this scene, which save time where nothing has moved.
    """
    env = arm.env
    present = env.present[0].cpu().numpy()
    slots = np.flatnonzero(present)
    poses = np.full((len(present), 7), np.nan)
    poses[slots] = [to_wxyz(arm.scene.object_in_base(slot)) for slot in slots.tolist()]
    hidden, obstacles = measure_clutter(arm)
    height, in_basket = to_native(env.object_states)[0, :, 2], _find_objects_in_basket(arm) & present
    return SceneMeasures(
        object_in_base=poses,
        hidden_fraction=np.where(present, hidden, np.nan),
        obstacles=np.where(present, obstacles.sum(axis=1), -1),
        free_grasps=_count_free_grasps(arm, poses, before),
        fallen=np.asarray(height < env.success_check.fallen_below) & present & ~in_basket,
        in_basket=in_basket,
        held=env.is_object_grasped()[0].cpu().numpy() & present,
        opening=measure_opening(arm),
    )


def measure_opening(arm: Arm) -> float:
    """Return the opening of the task's door or drawer as a fraction of its range; NaN without one."""
    env = arm.env
    if not isinstance(env, RoboCASOpenPickEnv):
        return float("nan")
    joint = env.model.joint_to_open
    assert joint is not None  # required by the task
    return float(env.opening_joint_position()[0]) / max(joint.limits, key=abs)


def measure_clutter(arm: Arm) -> tuple[Array, Array]:
    """Return the hidden fraction (K,) of each object, and whether each object is an obstacle around it (K, K)."""
    env = arm.env
    points = np.stack([occlusion.sample_points(asset.annotations.surface_points) for asset in env.object_assets[0]])
    columns = torch.as_tensor(np.ascontiguousarray(points.swapaxes(-1, -2)), dtype=torch.float32)[None]
    world = occlusion.surface_points_in_world(env.object_poses, columns)
    eye = torch.as_tensor(selection_camera(env.model).pose[:3, 3], dtype=torch.float32)
    count = len(points)
    clutter = occlusion.measure_clutter(
        world.expand(count, -1, -1, -1), env.present.expand(count, -1), torch.arange(count), eye
    )
    return clutter.hidden_fraction.numpy(), clutter.obstacles.numpy()


def _count_free_grasps(arm: Arm, poses: Array, before: SceneMeasures | None) -> Array:
    counts = np.full(len(poses), -1)
    slots = np.flatnonzero(~np.isnan(poses[:, 0]))
    if before is None:
        changed = slots
    else:
        counts[slots] = before.free_grasps[slots]
        moved = np.flatnonzero(np.abs(poses - before.object_in_base).max(axis=1) > _UNCHANGED)
        places = np.concatenate([poses[moved, :3], before.object_in_base[moved, :3]])
        distances = np.linalg.norm(poses[slots, None, :3] - places, axis=2)
        changed = slots[(distances <= _REACH).any(axis=1)] if len(moved) else slots[:0]
        if not np.isclose(before.opening, measure_opening(arm), equal_nan=True):
            changed = slots  # a door or drawer blocks other grasps now
    for slot in changed.tolist():
        counts[slot] = count_clear_grasps(arm, slot)
    return counts


def _find_objects_in_basket(arm: Arm) -> Array:
    env = arm.env
    if env.model.basket is None:
        return np.zeros(len(env.present[0]), dtype=bool)
    centers = env.success_check.centers_of_mass(to_native(env.object_states))
    inside = as_tensor(env.goal.is_at_goal(centers, to_native(env.basket_pose)))
    return inside[0].cpu().numpy()
