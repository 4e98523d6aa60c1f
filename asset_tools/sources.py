"""Sources of assets: the interface between importers, which create meshes, and the build of assets."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import trimesh

from asset_tools.grasps import Grasps
from asset_tools.inertia import piece_inertia, to_moments, to_tuple
from robocas_ms3.assets.manifest import Handle, InnerBox, Joint, Link, Surface, check_asset_name


@dataclass(frozen=True)
class ObjectSource:
    """Source of an object.

    Attributes:
        id: id and folder name.
        name: name in instructions.
        category: category of the object.
        mesh: visual mesh: textured, metres, z up, any origin.
        closed: watertight mesh of the same body in the same frame, for volume, hulls and grasps.
        mass: kg.
        friction: friction coefficient of the surface.
        source: source of the geometry.
        licence: licence of the mesh.
        attribution: credit for the mesh.
        repairs: repairs of the source mesh.
        graspnet_id: id of the same object, or of the replaced object, in GraspNet-1Billion.
        pieces: (V, 3) corners of convex pieces in the mesh's frame; None: computed by decomposition.
        grasps: known grasps in the mesh's frame; None: sampled.
        hollow: whether the object is a container or thin; its hulls are then checked by surface distance.
    """

    id: str
    name: str
    category: str
    mesh: trimesh.Trimesh
    closed: trimesh.Trimesh
    mass: float
    friction: float = 0.99
    source: str = "builtin"
    licence: str = "MIT"
    attribution: str = "robocas_ms3"
    repairs: tuple[str, ...] = ()
    graspnet_id: int | None = None
    pieces: list[np.ndarray] | None = None
    grasps: Grasps | None = None
    hollow: bool = False

    def __post_init__(self) -> None:
        """Check the name, which becomes a folder."""
        check_asset_name(self.id, "id of an object")


@dataclass(frozen=True)
class LinkSource:
    """A moving part of a piece of furniture, in the furniture's frame with all joints at 0; metres.

    Attributes:
        name: name of the link.
        joint: joint between the link and its parent.
        mesh: visual mesh.
        pieces: (V, 3) corners of each convex collision piece.
        mass: kg; centre of mass and inertia are those of the solid pieces.
        parent: name of another link; empty: the fixed body.
    """

    name: str
    joint: Joint
    mesh: trimesh.Trimesh
    pieces: list[np.ndarray]
    mass: float
    parent: str = ""

    def __post_init__(self) -> None:
        """Check the name, which becomes a folder."""
        check_asset_name(self.name, "name of a link")

    def to_link(self) -> Link:
        """Return the manifest entry of the link."""
        center, inertia, axes = piece_inertia(self.pieces, self.mass)
        return Link(
            name=self.name,
            parent=self.parent,
            joint=self.joint,
            mass=self.mass,
            center_of_mass=to_tuple(center),
            inertia=to_moments(inertia),
            inertia_wxyz=axes,
        )


@dataclass(frozen=True)
class FurnitureSource:
    """Source of a piece of furniture, in its own frame; metres.

    Attributes:
        id: id and folder name.
        name: name in instructions.
        category: category of the furniture.
        mesh: visual mesh of the fixed body.
        pieces: (V, 3) corners of each convex collision piece of the fixed body.
        mass: kg; None: the body is fixed. Centre of mass and inertia are those of the solid pieces.
        origin_height: height of the frame's origin above the lowest point, m.
        surfaces: surfaces for objects.
        inner: inside of a container.
        links: moving parts, parents first.
        handles: grasps of the moving parts.
        finishes: part -> finish -> mesh of the part, not included in ``mesh``; the first finish is the default.
    """

    id: str
    name: str
    category: str
    mesh: trimesh.Trimesh
    pieces: list[np.ndarray]
    mass: float | None = None
    origin_height: float = 0.0
    surfaces: dict[str, Surface] = field(default_factory=dict)
    inner: InnerBox | None = None
    links: tuple[LinkSource, ...] = ()
    handles: dict[str, Handle] = field(default_factory=dict)
    finishes: dict[str, dict[str, trimesh.Trimesh]] = field(default_factory=dict)
    friction: float = 0.99
    source: str = "builtin"
    licence: str = "MIT"
    attribution: str = "robocas_ms3"
    repairs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the names, which become folders and files."""
        check_asset_name(self.id, "id of a piece of furniture")
        for part, finishes in self.finishes.items():
            for name in (part, *finishes):
                check_asset_name(name, "name of a finish")
