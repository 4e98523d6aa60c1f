"""What it takes to make a builtin object."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from PIL import Image

from asset_tools.builtin.mesh import Shape, Size

Paint = Callable[[Shape, np.random.Generator], Image.Image]


@dataclass(frozen=True)
class ObjectSpec:
    """One object of the pack.

    Args:
        id: its folder's name. category: its kind.
        size: outer size (x, y, z), upright or as it usually lies, m.
        mass: kg.
        shape: makes the shape of that size. paint: makes its texture.
        roughness: of the surface, 0 mirror to 1 chalk.
        graspnet_id: of the object of GraspNet-1Billion that it stands in for.
        spoken: name for language; empty: made of the id.
        hollow: a container, or thin: its hulls are judged by distance, not by volume.
    """

    id: str
    category: str
    size: Size
    mass: float
    shape: Callable[[Size], Shape]
    paint: Paint
    roughness: float
    graspnet_id: int | None = None
    spoken: str = ""
    hollow: bool = False

    @property
    def name(self) -> str:
        """For language: 'sugar box'."""
        return self.spoken or self.id.replace("_", " ")

    def build(self) -> tuple[Shape, trimesh.Trimesh]:
        """The shape, and the textured mesh to render; the same every time."""
        shape = self.shape(self.size)
        rng = np.random.default_rng(zlib.crc32(self.id.encode()))
        return shape, shape.textured(self.paint(shape, rng), roughness=self.roughness)
