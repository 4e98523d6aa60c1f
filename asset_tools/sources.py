"""Sources of assets. An importer creates a source from files, and `build` writes the asset."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import trimesh

from asset_tools.grasps import Grasps
from asset_tools.inertia import compute_piece_inertia, round_moments, round_vector
from robocas_ms3.assets.manifest import Handle, InnerBox, Joint, Link, Surface, check_asset_name


@dataclass(frozen=True)
class ObjectSource:
    """Meshes and properties from which an object is built.

    Attributes:
        id: id of the object and name of its folder.
        name: name in instructions.
        category: category of the object.
        mesh: visual mesh: textured, metres, z up, any origin.
        closed: watertight mesh of the body in the frame of ``mesh``, from which volume, hulls and grasps are computed.
        mass: mass in kg.
        friction: friction coefficient of the surface.
        source: source of the geometry.
        licence: licence of the mesh.
        attribution: credit for the mesh.
        repairs: repairs of the source mesh.
        graspnet_id: number in GraspNet-1Billion of this object, or of the object that it replaces; None: none.
        pieces: corners (V, 3) of each convex piece in the mesh's frame; None: computed by decomposition.
        grasps: known grasps in the mesh's frame; None: sampled.
        hollow: whether the object is a container or thin. If so, the hulls are checked by surface distance, not by IoU.
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
        pieces: corners (V, 3) of each convex collision piece.
        mass: mass in kg. Centre of mass and inertia are computed from the pieces with uniform density.
        parent: name of the link to which the joint connects this link; empty: the fixed body.
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
        center, inertia, axes = compute_piece_inertia(self.pieces, self.mass)
        return Link(
            name=self.name,
            parent=self.parent,
            joint=self.joint,
            mass=self.mass,
            center_of_mass=round_vector(center),
            inertia=round_moments(inertia),
            inertia_wxyz=axes,
        )


@dataclass(frozen=True)
class FurnitureSource:
    """Meshes and properties from which a piece of furniture is built, in the furniture's frame; metres.

    Attributes:
        id: id of the furniture and name of its folder.
        name: name in instructions.
        category: category of the furniture.
        mesh: visual mesh of the body without moving parts.
        pieces: corners (V, 3) of each convex collision piece of this body.
        mass: mass in kg; None: the body is fixed in the scene. Centre of mass and inertia are computed from the pieces.
        origin_height: height of the frame's origin above the lowest point, m.
        surfaces: name -> surface on which objects can be placed.
        inner: free space inside a container; None: not a container.
        links: moving parts; each parent is before its children.
        handles: name -> grasp of a moving part.
        finishes: name of a part -> name of a finish -> mesh of the part with this finish. The meshes are not included
            in ``mesh``. The first finish is the default.
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
