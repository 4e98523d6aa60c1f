"""What assets are made from: the hand-over between those who read or invent meshes and those who build assets."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import trimesh

from asset_tools.grasps import Grasps
from asset_tools.inertia import piece_inertia, to_moments, to_tuple
from robocas_ms3.assets.manifest import Handle, InnerBox, Joint, Link, Surface, check_asset_name


@dataclass(frozen=True)
class ObjectSource:
    """What an object is made from.

    Attributes:
        id: folder name.
        name: for language.
        category: what kind of thing it is.
        mesh: to look at; textured, metres, z up, any origin.
        closed: watertight mesh of the same body in the same frame, for volume, hulls and grasps.
        mass: kg.
        friction: of its surface.
        source: where the geometry comes from.
        licence: of the mesh.
        attribution: whom to name.
        repairs: what had to be mended.
        graspnet_id: of the object of GraspNet-1Billion that it is or stands in for.
        pieces: (V, 3) corners of convex pieces, in the mesh's frame, where they are known; none: by decomposition.
        grasps: in the mesh's frame, where they are known; none: sampled.
        hollow: a container or a thin thing, whose hulls are judged by distance.
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
        """Check the name before a folder gets it."""
        check_asset_name(self.id, "id of an object")


@dataclass(frozen=True)
class LinkSource:
    """A moving part of a piece of furniture, in the furniture's frame with all joints at 0; metres.

    Attributes:
        name: of the link.
        joint: how it hangs on its parent.
        mesh: to look at.
        pieces: (V, 3) corners of each convex collision piece.
        mass: kg; its centre and inertia are those of the pieces, solid.
        parent: name of another link; empty: the fixed body.
    """

    name: str
    joint: Joint
    mesh: trimesh.Trimesh
    pieces: list[np.ndarray]
    mass: float
    parent: str = ""

    def __post_init__(self) -> None:
        """Check the name before a folder gets it."""
        check_asset_name(self.name, "name of a link")

    def facts(self) -> Link:
        """What a pack says of it."""
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
    """What a piece of furniture is made from; everything in its own frame, metres.

    Attributes:
        id: folder name.
        name: for language.
        category: what kind of thing it is.
        mesh: to look at, of the fixed body.
        pieces: (V, 3) corners of each convex collision piece of the fixed body.
        mass: kg; none: it can't move. Its centre and inertia are those of the pieces, solid.
        origin_height: of the frame above the lowest point.
        surfaces: where objects may stand.
        inner: inside of a container.
        links: moving parts, parents first.
        handles: where to take hold of them.
        finishes: part -> finish -> mesh of that part; the first is the default. Not in ``mesh``.
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
        """Check the names before folders and files get them."""
        check_asset_name(self.id, "id of a piece of furniture")
        for part, finishes in self.finishes.items():
            for name in (part, *finishes):
                check_asset_name(name, "name of a finish")
