"""Viewpoints of tasks: where an overview camera is and what it looks at, (3,) each in the world, m."""

from __future__ import annotations

import numpy as np

from robocas_ms3.scenes.layout import Array
from robocas_ms3.scenes.model import SceneModel

_STATIC_CAMERA_SHARE = 0.75  # of the render camera's distance, as it sees 90 deg instead of 60


def over_the_shoulder(model: SceneModel) -> tuple[Array, Array]:
    """Return a viewpoint over the robot's shoulder, from its right, of what stands on the support."""
    region, robot = model.region, model.robot_pose[:3, 3]
    middle = np.array([*np.add(region.min_xy, region.max_xy) / 2, region.z, 1.0])
    target = (model.support_pose @ middle)[:3]
    back = (robot - target)[:2] / np.linalg.norm((robot - target)[:2])
    aside = np.array([-back[1], back[0]])
    eye = target + np.append(1.05 * back + 1.2 * aside, max(1.1, 1.5 - target[2]))
    return eye, target + [0, 0, 0.05]


def above_the_basket(model: SceneModel) -> tuple[Array, Array]:
    """Return a viewpoint above the basket's side, where an opening door does not hide the gripper."""
    opening = model.config.opening
    assert opening is not None  # checked by the configuration
    assert model.basket_pose is not None
    handle = model.furniture[opening.furniture].asset.handles[opening.handle]
    held = model.furniture_poses[opening.furniture] @ np.append(handle.position, 1.0)
    out = model.robot_pose[:2, 3] - held[:2]
    out /= np.linalg.norm(out)
    side = np.array([-out[1], out[0]])
    if side @ (model.basket_pose[:2, 3] - held[:2]) < 0:
        side = -side
    return np.append(held[:2] + 0.9 * out + 1.4 * side, held[2] + 0.9), np.append(held[:2] + 0.3 * out, held[2] + 0.1)


def static_camera(overview: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the viewpoint of the static camera that replaces the robot's own: an overview from nearer."""
    eye, target = overview
    return target + _STATIC_CAMERA_SHARE * (eye - target), target
