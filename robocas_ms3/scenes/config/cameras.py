"""The cameras of a task configuration: changes of the robot's cameras, and additional cameras."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.strict_model import StrictModel, did_you_mean
from robocas_ms3.robots.cameras import CAMERA_NAME, CameraSpec, Mount

_Coordinate = Annotated[float, Field(ge=-100, le=100)]
_Angle = Annotated[float, Field(ge=-360, le=360)]
_Pixels = Annotated[int, Field(ge=16, le=8192, multiple_of=2)]


class CameraConfig(StrictModel):
    """Changes of a camera of the robot, or an additional camera, which needs `position` or `overview`."""

    mount: Mount | None = Field(
        default=None, description="body that carries the camera; world for an additional camera"
    )
    position: tuple[_Coordinate, _Coordinate, _Coordinate] | None = Field(
        default=None, description="position in the frame of the mount (world, base link, hand link), m"
    )
    rotation_deg: tuple[_Angle, _Angle, _Angle] | None = Field(
        default=None,
        description="roll, pitch, yaw (fixed axes) in the frame of the mount; the camera looks along x, z is up",
    )
    look_at: tuple[_Coordinate, _Coordinate, _Coordinate] | None = Field(
        default=None,
        description="point at which the camera looks, in the frame of the mount, m; instead of `rotation_deg`",
    )
    overview: bool | None = Field(
        default=None, description="whether the task places the camera so that it sees the whole scene"
    )
    fov_deg: Annotated[float, Field(gt=0, lt=180)] | None = Field(
        default=None, description="vertical field of view; 90 for an additional camera"
    )
    width: _Pixels | None = Field(default=None, description="image width, pixels; 640 for an additional camera")
    height: _Pixels | None = Field(default=None, description="image height, pixels; 480 for an additional camera")

    @model_validator(mode="after")
    def _check_direction(self) -> CameraConfig:
        if self.rotation_deg is not None and self.look_at is not None:
            raise ValueError("expected only one of the keys rotation_deg and look_at, found both")
        return self

    def apply_to(self, camera: CameraSpec) -> CameraSpec:
        given: dict[str, Any] = self.model_dump(exclude_none=True)
        angles, fov = given.pop("rotation_deg", None), given.pop("fov_deg", None)
        if angles is not None:
            given |= {"rpy": tuple(np.deg2rad(angles).tolist()), "look_at": None}
        if fov is not None:
            given["fov"] = float(np.deg2rad(fov))
        if {"position", "rpy", "look_at"} & given.keys():
            given.setdefault("overview", False)
        return replace(camera, **given)


def _check_names(cameras: dict[str, CameraConfig]) -> dict[str, CameraConfig]:
    for name in cameras:
        if not re.fullmatch(CAMERA_NAME, name):
            raise ValueError(f"expected a camera name that ends in _camera, such as side_camera, found {name!r}")
    return cameras


CamerasConfig = Annotated[dict[str, CameraConfig], AfterValidator(_check_names)]


def apply_camera_changes(
    cameras: tuple[CameraSpec, ...], changes: list[tuple[str, CameraConfig]]
) -> tuple[CameraSpec, ...]:
    """Change cameras by name, and add the cameras with new names.

    Args:
        cameras: cameras of the robot.
        changes: name and changed values of each camera; a name may occur several times.

    Returns:
        The cameras of the robot with their changes, followed by the additional cameras.

    Raises:
        ConfigError: an additional camera has neither `position` nor `overview`.
    """
    specs = {camera.name: camera for camera in cameras}
    for name, change in changes:
        if name not in specs and change.position is None and not change.overview:
            raise ConfigError(
                "unknown camera",
                where=f"cameras.{name}",
                expected=f"one of {', '.join(specs)}, or for an additional camera the key `position` or `overview`",
                fix=did_you_mean(name, specs),
            )
        specs[name] = change.apply_to(specs.get(name, CameraSpec(name)))
    return tuple(specs.values())
