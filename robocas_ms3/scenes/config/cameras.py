"""The cameras of a task configuration: changes of the robot's cameras, and further ones."""

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
    """A camera by its name, which ends in `_camera`. A further camera needs `position` or `overview`."""

    mount: Mount | None = Field(default=None, description="what it is fixed to; default: world")
    position: tuple[_Coordinate, _Coordinate, _Coordinate] | None = Field(
        default=None, description="in the frame of the world, of the base link or of the hand link, m"
    )
    rotation_deg: tuple[_Angle, _Angle, _Angle] | None = Field(
        default=None, description="roll, pitch, yaw in that frame; a camera looks along x, and z is up"
    )
    look_at: tuple[_Coordinate, _Coordinate, _Coordinate] | None = Field(
        default=None, description="point in that frame that it looks at, m, instead of `rotation_deg`"
    )
    overview: bool | None = Field(default=None, description="the task places it, where it sees the whole scene")
    fov_deg: Annotated[float, Field(gt=0, lt=180)] | None = Field(
        default=None, description="vertical field of view; default: 90"
    )
    width: _Pixels | None = Field(default=None, description="default: 640")
    height: _Pixels | None = Field(default=None, description="default: 480")

    @model_validator(mode="after")
    def _one_direction(self) -> CameraConfig:
        if self.rotation_deg is not None and self.look_at is not None:
            raise ValueError("rotation_deg and look_at exclude each other")
        return self

    def change(self, camera: CameraSpec) -> CameraSpec:
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
            raise ValueError(f"expected names like side_camera, found {name!r}")
    return cameras


CamerasConfig = Annotated[dict[str, CameraConfig], AfterValidator(_check_names)]


def apply_camera_changes(
    cameras: tuple[CameraSpec, ...], changes: list[tuple[str, CameraConfig]]
) -> tuple[CameraSpec, ...]:
    """Return cameras with changes, and the further ones, in this order.

    Raises:
        ConfigError: a further camera has no place.
    """
    specs = {camera.name: camera for camera in cameras}
    for name, change in changes:
        if name not in specs and change.position is None and not change.overview:
            raise ConfigError(
                "no such camera, and no place for a further one",
                where=f"cameras.{name}",
                expected=f"one of {list(specs)}, or `position`",
                fix=did_you_mean(name, specs),
            )
        specs[name] = change.change(specs.get(name, CameraSpec(name)))
    return tuple(specs.values())
