"""Rigid bodies joined from convex solids: boards, bars, discs; each cut from a sample of its material.

Frame of all furniture: metres, x out of its front, y to the right of whoever faces it, z up, the floor at 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from asset_tools.builtin.materials import Grid, Material
from asset_tools.builtin.mesh import Patch, creased_shape, pack_regions
from asset_tools.builtin.textures import Painter
from robocas_ms3.assets.manifest import Handle, Joint, Surface

Array = np.ndarray
Vec3 = tuple[float, float, float]
Corner = Sequence[float] | Array

BAR = 0.012  # m, thickness of handles
BAR_GAP = 0.042  # m of free room behind them
BEVEL = 0.0015

# PhysX takes a joint's friction as a share of the load it carries. With these, 3 to 5 N at the handle start a part
# moving, about 10 N move it at 0.2 m/s, and it stays where it is left.
SLIDE_FRICTION, SLIDE_DAMPING = 0.05, 30.0  # -, N s/m
HINGE_FRICTION, HINGE_DAMPING = 0.02, 6.0  # -, N m s/rad


def block(low: Corner, high: Corner, bevel: float = 0.0) -> Array:
    """Corners (8, 3) of a box, or (24, 3) of one with bevelled edges."""
    lower, upper = np.minimum(low, high), np.maximum(low, high)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    center, half = (lower + upper) / 2, (upper - lower) / 2
    if bevel <= 0:
        return center + signs * half
    return np.concatenate([center + signs * (half - bevel * (1 - axis)) for axis in np.eye(3)])


def disc(center: Vec3, radius: float, thickness: float, *, sides: int = 28, bevel: float = 0.0) -> Array:
    """Return the corners of a vertical prism that approximates a cylinder; the centre is that of its bottom."""
    angles = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    levels = [(0.0, radius), (thickness, radius)]
    if bevel:
        levels = [(0.0, radius - bevel), (bevel, radius), (thickness - bevel, radius), (thickness, radius - bevel)]
    return np.concatenate([np.column_stack([ring * r, np.full(sides, z)]) for z, r in levels]) + center


class Body:
    """What one rigid body is joined from.

    Args:
        materials: by name.
        seed: places of the sample at which boards are cut.
        texture: width of its texture, pixels.
        roughness: of its surface.
    """

    def __init__(
        self, materials: dict[str, Material], *, seed: int = 0, texture: int = 1024, roughness: float = 0.6
    ) -> None:
        self.materials, self.texture, self.roughness = materials, texture, roughness
        self.rng = np.random.default_rng(seed)
        self.pieces: list[Array] = []
        self._solids: list[tuple[Array, str, int | None]] = []

    def solid(
        self, points: Array, material: str, *, grain: int | None = None, show: bool = True, collide: bool = True
    ) -> None:
        """Add the convex hull of points (k, 3).

        Args:
            points: m.
            material: its name.
            grain: axis (0, 1, 2) along which it is cut; none: its longest.
            show: in the visual mesh.
            collide: as a collision piece.
        """
        if show:
            self._solids.append((points, material, grain))
        if collide:
            self.pieces.append(points)

    def board(
        self,
        low: Corner,
        high: Corner,
        material: str,
        *,
        bevel: float = 0.0,
        grain: int | None = None,
        collide: bool = True,
    ) -> None:
        """Add a box; its bevelled edges are only for the eye."""
        self.solid(block(low, high, bevel), material, grain=grain, collide=False)
        if collide:
            self.pieces.append(block(low, high))

    def bar_handle(
        self, middle: Corner, length: float, material: str, *, along: Literal["y", "z"], bar: float = BAR
    ) -> None:
        """Add a bar on two posts in front of a face with normal x; ``middle`` is the bar's axis' middle."""
        x, *_ = middle
        axis = 1 if along == "y" else 2
        half = np.full(3, bar / 2)
        half[axis] = length / 2
        self.board(middle - half, middle + half, material, bevel=0.0025)
        for side in (-1, 1):
            post = np.array(middle, float)
            post[axis] += side * (length / 2 - bar)
            low, high = post - bar / 2, post + bar / 2
            low[0], high[0] = x - bar / 2 - BAR_GAP, x - bar / 2
            self.board(low, high, material)

    def mesh(self) -> trimesh.Trimesh:
        """The textured mesh; the same every time."""
        names = sorted({material for _, material, _ in self._solids})
        nothing = np.zeros((2, 2, 3)), np.zeros((2, 2, 2))
        samples = {name: self.materials[name] for name in names}
        regions = pack_regions(
            [Patch(name, *nothing, sample.size, sample.detail) for name, sample in samples.items()], self.texture
        )
        vertices, uvs = [], []
        for points, material, grain in self._solids:
            corners, uv = _cut(points, samples[material].size, grain, self.rng)
            left, top, right, bottom = regions[material].box
            pixel = np.stack([left + uv[..., 0] * (right - left), bottom - uv[..., 1] * (bottom - top)], axis=-1)
            vertices.append(corners.reshape(-1, 3))
            uvs.append((pixel / self.texture * (1, -1) + (0, 1)).reshape(-1, 2))
        flat = np.concatenate(vertices)
        shape = creased_shape(flat, np.concatenate(uvs), np.arange(len(flat)).reshape(-1, 3), self.texture)
        painter = Painter(replace(shape, regions=regions), self.rng, (128, 128, 128))
        for name, region in regions.items():
            left, top, right, bottom = region.box
            grid = Grid.of(region.size, (right - left, bottom - top))
            rng = np.random.default_rng([ord(letter) for letter in name])
            painter.put(name, np.clip(samples[name].paint(grid, rng), 0, 255).astype(np.uint8))
        return shape.textured(Image.fromarray(painter.pixels), roughness=self.roughness)


def _cut(
    points: Array, sample: tuple[float, float], grain: int | None, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Triangles (f, 3, 3) of a convex solid, and UVs (f, 3, 2) in 0 to 1 by which each is cut from the sample."""
    hull = trimesh.convex.convex_hull(points)
    corners = np.asarray(hull.triangles)
    side = np.argmax(np.round(np.abs(hull.face_normals), 6), axis=1)
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    along = int(np.argmax(extent)) if grain is None else grain
    uv = np.zeros((*corners.shape[:2], 2))
    places = rng.uniform(size=(3, 2))
    for axis in range(3):
        first, second = [other for other in range(3) if other != axis]
        if second == along or (along == axis and extent[second] > extent[first]):
            first, second = second, first
        picked = side == axis
        for place, (goal, source) in enumerate(((0, first), (1, second))):
            scale = min(1.0, sample[goal] / extent[source])  # what is too large stretches the sample
            slack = sample[goal] - extent[source] * scale
            offset = places[axis, place] * slack
            uv[picked, :, goal] = ((corners[picked][..., source] - low[source]) * scale + offset) / sample[goal]
    return corners, uv


def slide(name: str, way: Vec3, length: float) -> Joint:
    """A joint that slides."""
    return Joint(
        name=name,
        kind="prismatic",
        axis=way,
        limits=(0.0, length),
        friction=SLIDE_FRICTION,
        damping=SLIDE_DAMPING,
    )


def hinge(name: str, origin: Vec3, side: Literal[-1, 1], angle: float = 1.9) -> Joint:
    """An upright hinge of a front door at its left (-1) or right (1) edge."""
    return Joint(
        name=name,
        kind="revolute",
        axis=(0.0, 0.0, float(side)),
        origin=origin,
        limits=(0.0, angle),
        friction=HINGE_FRICTION,
        damping=HINGE_DAMPING,
    )


def bar_grip(link: str, middle: Vec3, *, along: Literal["y", "z"], bar: float = BAR) -> Handle:
    """How to take a bar from the front: approach -x, the fingers on both sides of it."""
    closing = np.array([0.0, 1.0, 0.0]) if along == "z" else np.array([0.0, 0.0, 1.0])
    approach = np.array([-1.0, 0.0, 0.0])
    turn = Rotation.from_matrix(np.column_stack([np.cross(closing, approach), closing, approach]))
    x, y, z, w = (round(float(value), 9) for value in turn.as_quat())
    return Handle(link=link, position=middle, wxyz=(w, x, y, z), width=bar)


def surface(
    low: tuple[float, float], high: tuple[float, float], z: float, headroom: float | None = None, link: str = ""
) -> Surface:
    """Where things may stand; the headroom is given with a millimetre to spare."""
    room = None if headroom is None else round(headroom - 0.001, 6)
    return Surface(link=link, min_xy=low, max_xy=high, z=z, headroom=room)
