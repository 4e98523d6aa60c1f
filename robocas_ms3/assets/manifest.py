"""The declared format of an asset pack: ``manifest.json`` and the files it lists.

A pack is a folder::

    manifest.json                 PackManifest
    <asset id>/visual_fast.glb    textured mesh for rendering, about 1000 triangles
              /visual_full.glb    the same with all the detail worth showing
              /hulls.obj          convex hulls for physics, one ``o`` group each
              /annotations.npz    (objects only) see ``Annotations`` in ``annotations.py``
              /links/<link>/...   (articulated furniture only) the same three files of each moving part
              /finishes/<part>_<finish>.glb    (rooms only) a part that comes in several finishes

All meshes of an asset share one frame: metres, z up. An object's origin is the centre of its visual mesh's bounding
box. Furniture keeps the frame its task numbers are given in: x forward (out of its front) or as upstream has it. The
frames of all links of a piece of furniture coincide with its own when every joint is at 0, which is closed.
"""

from __future__ import annotations

import re
from pathlib import PurePosixPath
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.strict_model import MAX_NAME_BYTES, StrictModel

SCHEMA_VERSION = 2

# What the fixed body of articulated furniture is called in the simulator, and the joint that fixes it
BODY = "body"


def _unit(wxyz: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if abs(sum(x * x for x in wxyz) ** 0.5 - 1) > 1e-3:
        raise ValueError(f"{wxyz} is no unit quaternion")
    return wxyz


def _of_a_body(moments: tuple[float, float, float]) -> tuple[float, float, float]:
    a, b, c = sorted(moments)
    if a + b < 0.99 * c:  # within what rounding does to a flat body, whose moments just add up
        raise ValueError(f"no body has the moments of inertia {moments}: the largest is more than the others' sum")
    return moments


def _inside(path: str) -> str:
    parts = PurePosixPath(path)
    if parts.is_absolute() or ".." in parts.parts or str(parts) != path:
        raise ValueError(f"{path!r} is no plain path inside the asset's folder")
    return path


Vec3 = tuple[float, float, float]
Quaternion = Annotated[
    tuple[float, float, float, float], Field(description="wxyz, of length 1 within 1e-3"), AfterValidator(_unit)
]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
PrincipalMoments = Annotated[
    tuple[Positive, Positive, Positive], Field(description="principal moments, kg m2"), AfterValidator(_of_a_body)
]
Name = Annotated[str, Field(pattern=r"^[a-z0-9_]+$", max_length=MAX_NAME_BYTES)]
FilePath = Annotated[str, Field(pattern=r"^[a-z0-9_./-]+$"), AfterValidator(_inside)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def check_asset_name(name: str, where: object) -> None:
    """Check that a name can be that of an asset, a link or a finish, which are folders and files of a pack."""
    if re.fullmatch("[a-z0-9_]+", name) is None or len(name) > MAX_NAME_BYTES:
        expected = f"1 to {MAX_NAME_BYTES} small letters, digits and underscores"
        raise AssetError("this name can't be used in a pack", where=where, expected=expected, found=repr(name)[:80])


class Surface(StrictModel):
    """A horizontal rectangle of a piece of furniture on which objects may stand, in the furniture's frame (metres)."""

    link: str = Field(default="", description="the moving part it belongs to; empty: the fixed body")
    min_xy: tuple[float, float]
    max_xy: tuple[float, float]
    z: float
    headroom: Positive | None = Field(default=None, description="free height above it, m; none: open to the sky")

    @model_validator(mode="after")
    def _sound(self) -> Surface:
        if not all(low < high for low, high in zip(self.min_xy, self.max_xy, strict=True)):
            raise ValueError(f"min_xy {self.min_xy} must lie below max_xy {self.max_xy}")
        return self


class InnerBox(StrictModel):
    """The inside of a container: an axis-aligned box in the container's frame (metres)."""

    min: Vec3
    max: Vec3


class Joint(StrictModel):
    """How a moving part hangs on the rest, everything in the furniture's frame with all joints at 0."""

    name: Name
    kind: Literal["prismatic", "revolute"]
    axis: Vec3 = Field(description="unit vector: the way it slides, or turns by the right-hand rule")
    origin: Vec3 = Field(default=(0, 0, 0), description="a point on the axis, m")
    limits: tuple[float, float] = Field(description="m or rad; 0, which is closed, lies within")
    friction: NonNegative = Field(description="Coulomb friction, as PhysX has it")
    damping: NonNegative = Field(description="N s/m or N m s/rad")

    @model_validator(mode="after")
    def _sound(self) -> Joint:
        if abs(sum(x * x for x in self.axis) - 1) > 1e-6:
            raise ValueError(f"axis {self.axis} is no unit vector")
        if not self.limits[0] <= 0 <= self.limits[1] or self.limits[0] == self.limits[1]:
            raise ValueError(f"0, which is closed, must lie within limits {self.limits}")
        return self


class Link(StrictModel):
    """A moving part of a piece of furniture."""

    name: Name
    parent: str = Field(default="", description="name of another link; empty: the fixed body")
    joint: Joint
    mass: Positive
    center_of_mass: Vec3
    inertia: PrincipalMoments
    inertia_wxyz: Quaternion = (1, 0, 0, 0)


class Handle(StrictModel):
    """Where to take hold of a moving part: pose of the TCP (z approach, y closing), furniture's frame, joints at 0."""

    link: Name
    position: Vec3
    wxyz: Quaternion
    width: Positive = Field(description="of the handle between the fingers, m")


class ObjectQuality(StrictModel):
    """What was measured of an object when it was made; see docs/assets.md for how."""

    compact: bool = Field(description="False: thin or hollow, judged by surface distance instead of volume")
    hull_count: int = Field(ge=1)
    hull_vertices: int = Field(ge=4, description="of the largest hull")
    volume_iou: Fraction = Field(description="overlap of the hulls with the closed mesh they were made from")
    surface_p95: NonNegative = Field(description="95th percentile of the distances between both surfaces, m")
    rest_share: Fraction = Field(
        description="of drops that end in a listed resting pose, at rest in time, not jittering"
    )
    rolling_share: Fraction = Field(
        default=0, description="of drops that count as at rest only because they roll evenly"
    )
    rest_time: NonNegative = Field(description="median time until at rest after the drop, s")
    penetration: NonNegative = Field(description="deepest into the plane at rest, m")
    jitter: NonNegative = Field(description="largest kinetic energy from 2 s to 3 s of drops that don't roll, J per kg")
    grasps_tried: int = Field(ge=0)
    grasps_held: Fraction = Field(description="of those tried: still in the hand after lifting and shaking")


class FurnitureQuality(StrictModel):
    """What was measured of a piece of furniture when it was made."""

    hull_count: int = Field(ge=1)
    hull_vertices: int = Field(ge=4)
    joints_open: Fraction | None = Field(
        default=None, description="share of joints that a force opens and closes again"
    )
    surfaces_hold: Fraction | None = Field(default=None, description="share of surfaces on which objects stay")


class AssetBase(StrictModel):
    """Fields of every asset."""

    id: Name
    name: str = Field(min_length=1, description="for language: 'sugar box'")
    category: str
    source: str = Field(description="where the geometry comes from: 'builtin', 'scan', 'graspnet', 'ycb', 'partnet'")
    licence: str
    attribution: str
    units: Literal["m"] = "m"
    extents: tuple[NonNegative, NonNegative, NonNegative] = Field(
        description="size of the visual mesh's bounding box, m"
    )
    friction: Positive = 0.99
    repairs: tuple[str, ...] = Field(default=(), description="what the importer had to mend in the source mesh")
    files: dict[FilePath, Sha256] = Field(description="path inside the asset's folder -> sha256; there are no others")


class ObjectAsset(AssetBase):
    """A thing to pick up."""

    kind: Literal["object"] = "object"
    graspnet_id: int | None = Field(
        default=None, ge=0, description="of GraspNet-1Billion, which upstream's configs use"
    )
    mass: Positive = Field(description="kg")
    center_of_mass: Vec3 = Field(description="m, in the asset's frame")
    inertia: PrincipalMoments
    inertia_wxyz: Quaternion = (1, 0, 0, 0)
    grasp_count: int = Field(ge=0)
    no_grasps_because: str = Field(default="", description="why there are fewer grasps than usual, if so")
    quality: ObjectQuality


class FurnitureAsset(AssetBase):
    """A table, a basket, a room: scenery, with named surfaces."""

    kind: Literal["furniture"] = "furniture"
    mass: Positive | None = Field(default=None, description="kg; none: its body can't move")
    center_of_mass: Vec3 = (0, 0, 0)
    inertia: PrincipalMoments | None = Field(default=None, description="given if the mass is")
    inertia_wxyz: Quaternion = (1, 0, 0, 0)
    origin_height: float = Field(default=0.0, description="height of the frame's origin above the lowest point, m")
    surfaces: dict[Name, Surface] = {}
    inner: InnerBox | None = Field(default=None, description="containers only")
    links: tuple[Link, ...] = Field(default=(), description="moving parts, parents first")
    handles: dict[Name, Handle] = {}
    finishes: dict[Name, Annotated[tuple[Name, ...], Field(min_length=1)]] = Field(
        default={}, description="part -> its finishes, the default first"
    )
    quality: FurnitureQuality

    @model_validator(mode="after")
    def _sound(self) -> FurnitureAsset:
        if self.mass is not None and self.inertia is None:
            raise ValueError("a body with a mass needs its inertia too")
        known, joints = {""}, {BODY}
        for link in self.links:
            if link.parent not in known:
                raise ValueError(f"link {link.name!r} hangs on {link.parent!r}, which does not come before it")
            if link.name in {BODY, *known}:
                raise ValueError(f"two links are called {link.name!r}; {BODY!r} is the fixed one")
            if link.joint.name in joints:
                raise ValueError(f"two joints are called {link.joint.name!r}; {BODY!r} is the fixed one")
            known.add(link.name)
            joints.add(link.joint.name)
        named = {name: part.link for name, part in [*self.surfaces.items(), *self.handles.items()]}
        for name, link_name in named.items():
            if link_name not in known:
                raise ValueError(f"{name!r} belongs to link {link_name!r}, which is not there")
        return self


Asset = Annotated[ObjectAsset | FurnitureAsset, Field(discriminator="kind")]


class PackManifest(StrictModel):
    """The content of ``manifest.json``."""

    schema_version: Literal[2] = SCHEMA_VERSION
    name: str = Field(pattern=r"^[a-z0-9_\-]+$")
    description: str = ""
    assets: list[Asset]
