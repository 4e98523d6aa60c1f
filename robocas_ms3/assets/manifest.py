"""The declared format of an asset pack: ``manifest.json`` and the files it lists.

A pack is a folder::

    manifest.json            PackManifest
    <asset id>/visual.glb    textured mesh for rendering, decimated
              /hulls.obj     convex hulls for physics, one ``o`` group each
              /annotations.npz   (objects only) see ``Annotations`` in ``pack.py``

All meshes of an asset share one frame: metres, z up, origin at the centre of the visual mesh's bounding box for
objects; furniture keeps the frame its task numbers are given in.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

SCHEMA_VERSION = 1

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class StrictModel(BaseModel):
    """Unknown keys are errors; nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Surface(StrictModel):
    """A horizontal rectangle of a piece of furniture on which objects may stand, in the furniture's frame (metres)."""

    min_xy: tuple[float, float]
    max_xy: tuple[float, float]
    z: float


class InnerBox(StrictModel):
    """The inside of a container: an axis-aligned box in the container's frame (metres)."""

    min: Vec3
    max: Vec3


class AssetBase(StrictModel):
    """What every asset says of itself."""

    id: str = Field(pattern=r"^[a-z0-9_]+$")
    name: str = Field(min_length=1, description="for language: 'sugar box'")
    category: str
    source: str = Field(description="where the geometry comes from: 'builtin', 'scan', ...")
    licence: str
    attribution: str
    extents: Vec3 = Field(description="size of the visual mesh's bounding box, m")
    friction: Positive = 0.99
    files: dict[str, str] = Field(description="path inside the asset's folder -> sha256")


class ObjectAsset(AssetBase):
    """A thing to pick up."""

    kind: Literal["object"] = "object"
    mass: Positive = Field(description="kg")
    center_of_mass: Vec3 = Field(description="m, in the asset's frame")
    inertia: tuple[Positive, Positive, Positive] = Field(description="principal moments, kg m2")
    inertia_wxyz: tuple[float, float, float, float] = Field((1, 0, 0, 0), description="principal axes")
    hull_count: int = Field(ge=1)
    volume_iou: float = Field(ge=0, le=1, description="overlap of the hulls with the closed mesh they were made from")
    grasp_count: int = Field(ge=0)
    repairs: tuple[str, ...] = Field((), description="what the importer had to mend in the source mesh")


class FurnitureAsset(AssetBase):
    """A table, a basket, a room: scenery, with named surfaces."""

    kind: Literal["furniture"] = "furniture"
    mass: Positive | None = Field(None, description="kg; none: it can't move")
    center_of_mass: Vec3 = (0, 0, 0)
    inertia: tuple[Positive, Positive, Positive] | None = None
    origin_height: float = Field(0.0, description="height of the frame's origin above the lowest point, m")
    surfaces: dict[str, Surface] = {}
    inner: InnerBox | None = Field(None, description="containers only")


Asset = Annotated[ObjectAsset | FurnitureAsset, Field(discriminator="kind")]


class PackManifest(StrictModel):
    """``manifest.json``."""

    schema_version: Literal[1] = SCHEMA_VERSION
    name: str = Field(pattern=r"^[a-z0-9_\-]+$")
    description: str = ""
    assets: list[Asset]
