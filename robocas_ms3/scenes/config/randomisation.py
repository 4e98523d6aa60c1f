"""The block ``randomisation`` of a task configuration: what a seed decides in addition to the layout."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, StrictInt, model_validator

from robocas_ms3.core.strict_model import StrictModel


def _check_range(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] > values[1]:
        raise ValueError(f"expected [least, greatest] with least <= greatest, found {list(values)}")
    return values


Range = Annotated[
    tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]],
    Field(description="least and greatest intensity"),
    AfterValidator(_check_range),
]
Ids = Annotated[list[str | StrictInt], Field(min_length=1)]


class LightRandomisation(StrictModel):
    """Random intensity and direction of the lights, drawn for every episode."""

    ambient: Range = (0.25, 0.6)
    directional: Range = (0.6, 1.4)
    direction_deg: Annotated[float, Field(ge=0, le=60)] = Field(
        default=20.0, description="greatest angle between the drawn and the configured direction of the slanted light"
    )


class CameraRandomisation(StrictModel):
    """Random shift and rotation of the cameras, drawn for every episode."""

    position: Annotated[float, Field(ge=0, le=0.2)] = Field(
        default=0.02, description="greatest shift along each axis, m"
    )
    rotation_deg: Annotated[float, Field(ge=0, le=20)] = Field(
        default=2.0, description="greatest rotation about each axis"
    )
    min_position: Annotated[float, Field(ge=0)] = Field(default=0.0, description="least shift along each axis, m")
    min_rotation_deg: Annotated[float, Field(ge=0)] = Field(default=0.0, description="least rotation about each axis")

    @model_validator(mode="after")
    def _check_order(self) -> CameraRandomisation:
        for key in ("position", "rotation_deg"):
            least, most = getattr(self, f"min_{key}"), getattr(self, key)
            if least > most:
                raise ValueError(f"min_{key} {least:g}: expected at most {key}, {most:g}")
        return self


class PoseRandomisation(StrictModel):
    """Random shift and turn of the robot (or the basket), drawn for every episode."""

    position: Annotated[float, Field(ge=0, le=0.5)] = Field(default=0.03, description="greatest shift in x and y, m")
    yaw_deg: Annotated[float, Field(ge=0, le=180)] = Field(
        default=5.0, description="greatest turn about the vertical in either direction"
    )


class DistractorConfig(StrictModel):
    """Additional objects that are never the target."""

    ids: Ids = Field(description="ids of objects in the object pack, or numbers in GraspNet-1Billion")
    count: Annotated[
        tuple[Annotated[int, Field(ge=0, le=16)], Annotated[int, Field(ge=0, le=16)]], AfterValidator(_check_range)
    ] = Field(default=(1, 3), description="least and greatest number of distractors")


class RandomisationConfig(StrictModel):
    """Properties of the scene that the seed of an episode decides.

    A block that is not given changes nothing.
    """

    room: list[str] | None = Field(default=None, description="parts of the room (wall, floor) that get a random finish")
    finishes: dict[str, Annotated[list[str], Field(min_length=1)]] = Field(
        default={}, description="part of the room -> finishes to draw from; a part without an entry: all finishes"
    )
    lights: LightRandomisation | None = None
    cameras: CameraRandomisation | None = None
    robot: PoseRandomisation | None = None
    basket: PoseRandomisation | None = None
    object_sets: Annotated[list[Ids], Field(min_length=1)] | None = Field(
        default=None, description="sets of object ids; one set, drawn at random, replaces `objects.ids`"
    )
    count: tuple[Annotated[int, Field(ge=1, le=64)], Annotated[int, Field(ge=1, le=64)]] | None = Field(
        default=None, description="least and greatest number of objects without distractors; at most `objects.count`"
    )
    distractors: DistractorConfig | None = None
