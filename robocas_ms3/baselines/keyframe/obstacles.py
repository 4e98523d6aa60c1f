"""Choice of the object to move aside."""

from __future__ import annotations

import numpy as np

from robocas_ms3.baselines.keyframe.observed_scene import ObservedObject, ObservedScene
from robocas_ms3.core.poses import Array
from robocas_ms3.scenes.grasp_checks import is_gripper_clear


def find_middle(scene: ObservedScene) -> Array:
    """Return the middle (2,) of all objects, m."""
    return np.median(scene.points[scene.is_object][:, :2], axis=0)


def score_height(scene: ObservedScene, objects: list[ObservedObject]) -> list[float]:
    """Return a score per object: greater for high objects near the middle of all objects."""
    clouds, middle = [scene.points[one.mask] for one in objects], find_middle(scene)
    return [
        6 * float(np.percentile(points[:, 2], 95)) - float(np.linalg.norm(points.mean(axis=0)[:2] - middle))
        for points in clouds
    ]


def score_blocking(
    scene: ObservedScene, objects: list[ObservedObject], target: ObservedObject, grasps: Array
) -> list[float]:
    """Return a score per object: greater for objects that block grasps of the target, are near it and above it.

    grasps: (G, 4, 4) TCP poses of grasps of the target in the arm's base frame.
    """
    points_of_target = scene.points[target.mask]
    middle, top, scores = points_of_target.mean(axis=0)[:2], points_of_target[:, 2].max(), []
    for one in objects:
        points = scene.points[one.mask]
        blocked = 1 - is_gripper_clear(grasps, points).mean() if len(grasps) else 0.0
        gap = np.linalg.norm(points[:, :2] - middle, axis=1).min()
        scores.append(float(1.5 * blocked - 5 * gap + 4 * (np.percentile(points[:, 2], 95) - top)))
    return scores
