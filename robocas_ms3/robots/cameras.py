"""Camera specifications of the robots, used by agents, task configurations, datasets, policies and documentation."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import Literal

from robocas_ms3.core.errors import ExtensionError

Vec3 = tuple[float, float, float]
Mount = Literal["world", "base", "hand"]
Parent = Literal["world", "arm_base", "ee"]
PARENTS: Mapping[Mount, Parent] = {"world": "world", "base": "arm_base", "hand": "ee"}
"""Mount of a camera -> frame of its constant pose in datasets."""
PARENT_FRAMES: Mapping[Parent, str] = {
    "arm_base": "arm base (panda_link0)",
    "ee": "EEF: ManiSkill's TCP, z approach, y closing",
    "world": "world",
}
CAMERA_NAME = "[a-z][a-z0-9_]{0,40}_camera"
"""Regular expression for camera names, which are folders and keys of datasets."""


@dataclass(frozen=True)
class CameraSpec:
    """Specification of a camera. Camera frame as in SAPIEN: x forward, y left, z up.

    Attributes:
        name: name of the camera, which matches `CAMERA_NAME`, such as ``side_camera``.
        mount: body that carries the camera: the world, the base link or the hand link of the robot.
        position: position in the frame of the mount, m.
        rpy: roll, pitch and yaw (fixed axes) in the frame of the mount, rad; used if ``look_at`` is None.
        look_at: target point of the view in the frame of the mount, m, or None.
        overview: whether the task places the camera so that it sees the whole scene.
        fov: vertical field of view, rad.
        width, height: pixels.
        near, far: least and greatest depth, m.

    Raises:
        ExtensionError: the name does not match `CAMERA_NAME`, by which datasets recognize the folders of cameras.
    """

    name: str
    mount: Mount = "world"
    position: Vec3 = (0.0, 0.0, 0.0)
    rpy: Vec3 = (0.0, 0.0, 0.0)
    look_at: Vec3 | None = None
    overview: bool = False
    fov: float = pi / 2
    width: int = 640
    height: int = 480
    near: float = 0.01
    far: float = 10.0

    def __post_init__(self) -> None:
        if not re.fullmatch(CAMERA_NAME, self.name):
            raise ExtensionError(
                "invalid camera name", expected="a name that ends in _camera, such as side_camera", found=self.name
            )

    @property
    def parent(self) -> Parent:
        """Frame in which datasets store the pose of this camera."""
        return PARENTS[self.mount]


STANDARD_CAMERAS = (
    CameraSpec("base_camera", "base", (0, -0.3, 1.2), (0, 0.43633, 0), near=0.005, far=5),
    CameraSpec("gripper_camera", "hand", (0.05, 0, 0.05), (pi, -pi / 2, 0), near=0.001, far=5),
    CameraSpec("static_camera", "world", (1, 1.5, 1.5), (0, pi / 3, -pi / 2), near=0.05),
)
"""Cameras of RoboCAS-v0. The static camera looks at a table in front of the robot."""
STANDARD_CAMERA_NAMES = tuple(camera.name for camera in STANDARD_CAMERAS)
EE_CAMERA = next(camera.name for camera in STANDARD_CAMERAS if camera.mount == "hand")
"""Camera whose pose shows the orientation of a dataset's EEF frame."""


def standard_camera_parent(camera: str) -> Parent:
    """Return the frame in which datasets store the pose of a camera of this name.

    The result is ``world`` for all cameras that are not standard cameras.
    """
    for spec in STANDARD_CAMERAS:
        if spec.name == camera:
            return spec.parent
    return "world"
