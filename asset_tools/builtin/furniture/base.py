"""Make rigid bodies of furniture from convex solids: boards, bars and discs.

Frame of all furniture: metres, x points out of the front, y to the right of a person who faces the furniture, z up; the
floor is at z = 0.
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
from asset_tools.builtin.mesh import Patch, make_creased_shape, pack_regions
from asset_tools.builtin.textures import Painter
from robocas_ms3.assets.manifest import Handle, Joint, Surface

Array = np.ndarray
Vec3 = tuple[float, float, float]
Corner = Sequence[float] | Array

BAR = 0.012  # m, thickness of handles
BAR_GAP = 0.042  # m, free space behind a handle
BEVEL = 0.0015

# In PhysX, the friction of a joint is a fraction of its load. With these values, a part starts to move at 3 to 5 N at
# the handle, moves at 0.2 m/s at about 10 N, and stays where it is released.
SLIDE_FRICTION, SLIDE_DAMPING = 0.05, 30.0  # -, N s/m
HINGE_FRICTION, HINGE_DAMPING = 0.02, 6.0  # -, N m s/rad


def make_box_corners(low: Corner, high: Corner, bevel: float = 0.0) -> Array:
    """Return the corners (8, 3) of a box, or the corners (24, 3) of a box with bevelled edges.

    Args:
        low: (3,) one corner, m.
        high: (3,) the opposite corner, m.
        bevel: width of the bevel, m; 0: sharp edges.
    """
    lower, upper = np.minimum(low, high), np.maximum(low, high)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    center, half = (lower + upper) / 2, (upper - lower) / 2
    if bevel <= 0:
        return center + signs * half
    return np.concatenate([center + signs * (half - bevel * (1 - axis)) for axis in np.eye(3)])


def make_disc_corners(center: Vec3, radius: float, thickness: float, *, sides: int = 28, bevel: float = 0.0) -> Array:
    """Return the corners (k, 3) of a horizontal disc, approximated by a prism.

    Args:
        center: centre of the bottom, m.
        radius: radius of the disc, m.
        thickness: height of the disc, m.
        sides: number of sides of the prism.
        bevel: width of the bevel of the rims, m; 0: sharp rims.
    """
    angles = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    levels = [(0.0, radius), (thickness, radius)]
    if bevel:
        levels = [(0.0, radius - bevel), (bevel, radius), (thickness - bevel, radius), (thickness, radius - bevel)]
    return np.concatenate([np.column_stack([ring * r, np.full(sides, z)]) for z, r in levels]) + center


class Body:
    """A rigid body of furniture to which solids are added.

    Args:
        materials: name -> material.
        seed: seed of the places at which the textures of boards are cut from the samples of the materials.
        texture: width and height of the texture in pixels.
        roughness: roughness of the surface, 0 to 1.
    """

    def __init__(
        self, materials: dict[str, Material], *, seed: int = 0, texture: int = 1024, roughness: float = 0.6
    ) -> None:
        self.materials, self.texture, self.roughness = materials, texture, roughness
        self.rng = np.random.default_rng(seed)
        self.pieces: list[Array] = []
        self._solids: list[tuple[Array, str, int | None]] = []

    def add_solid(
        self, points: Array, material: str, *, grain: int | None = None, show: bool = True, collide: bool = True
    ) -> None:
        """Add a solid that is the convex hull of points.

        Args:
            points: (k, 3) points, m.
            material: name of the material.
            grain: axis 0, 1 or 2 of the grain of the material; None: the longest side of the solid.
            show: whether to add the solid to the visual mesh.
            collide: whether to add the solid to the collision pieces.
        """
        if show:
            self._solids.append((points, material, grain))
        if collide:
            self.pieces.append(points)

    def add_board(
        self,
        low: Corner,
        high: Corner,
        material: str,
        *,
        bevel: float = 0.0,
        grain: int | None = None,
        collide: bool = True,
    ) -> None:
        """Add a box, whose bevelled edges are only in the visual mesh; other arguments as in `add_solid`.

        Args:
            low: (3,) one corner, m.
            high: (3,) the opposite corner, m.
            material: name of the material.
            bevel: width of the bevel, m.
            grain: axis of the grain of the material, or None.
            collide: whether to add the box to the collision pieces.
        """
        self.add_solid(make_box_corners(low, high, bevel), material, grain=grain, collide=False)
        if collide:
            self.pieces.append(make_box_corners(low, high))

    def add_bar_handle(
        self, middle: Corner, length: float, material: str, *, along: Literal["y", "z"], bar: float = BAR
    ) -> None:
        """Add a handle in front of a face with the normal +x: a bar on two posts.

        Args:
            middle: (3,) centre of the bar, m.
            length: length of the bar, m.
            material: name of the material.
            along: axis of the bar.
            bar: thickness of the bar, m.
        """
        x, *_ = middle
        axis = 1 if along == "y" else 2
        half = np.full(3, bar / 2)
        half[axis] = length / 2
        self.add_board(middle - half, middle + half, material, bevel=0.0025)
        for side in (-1, 1):
            post = np.array(middle, float)
            post[axis] += side * (length / 2 - bar)
            low, high = post - bar / 2, post + bar / 2
            low[0], high[0] = x - bar / 2 - BAR_GAP, x - bar / 2
            self.add_board(low, high, material)

    def make_mesh(self) -> trimesh.Trimesh:
        """Return the textured mesh of all visible solids; deterministic."""
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
        shape = make_creased_shape(flat, np.concatenate(uvs), np.arange(len(flat)).reshape(-1, 3), self.texture)
        painter = Painter(replace(shape, regions=regions), self.rng, (128, 128, 128))
        for name, region in regions.items():
            left, top, right, bottom = region.box
            grid = Grid.from_size(region.size, (right - left, bottom - top))
            rng = np.random.default_rng([ord(letter) for letter in name])
            painter.put_pixels(name, np.clip(samples[name].paint(grid, rng), 0, 255).astype(np.uint8))
        return shape.make_textured_mesh(Image.fromarray(painter.pixels), roughness=self.roughness)


def _cut(
    points: Array, sample: tuple[float, float], grain: int | None, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Triangulate a convex solid and cut its texture from a sample of a material.

    Args:
        points: (k, 3) corners of the solid, m.
        sample: size of the sample along the grain and across, m.
        grain: axis of the grain in the solid; None: the longest side.
        rng: random generator of the places in the sample.

    Returns:
        Triangles (f, 3, 3), and texture coordinates (f, 3, 2) in the sample, 0 to 1.
    """
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
            scale = min(1.0, sample[goal] / extent[source])  # the sample is stretched on a larger solid
            slack = sample[goal] - extent[source] * scale
            offset = places[axis, place] * slack
            uv[picked, :, goal] = ((corners[picked][..., source] - low[source]) * scale + offset) / sample[goal]
    return corners, uv


def make_slide(name: str, way: Vec3, length: float) -> Joint:
    """Return a sliding joint that opens in the direction ``way``, a unit vector, by ``length`` in m."""
    return Joint(
        name=name,
        kind="prismatic",
        axis=way,
        limits=(0.0, length),
        friction=SLIDE_FRICTION,
        damping=SLIDE_DAMPING,
    )


def make_hinge(name: str, origin: Vec3, side: Literal[-1, 1], angle: float = 1.9) -> Joint:
    """Return a vertical hinge at the left (-1) or right (1) edge of a door at the front.

    Args:
        name: name of the joint.
        origin: a point on the axis, m.
        side: edge of the door with the hinge.
        angle: largest opening angle, rad.
    """
    return Joint(
        name=name,
        kind="revolute",
        axis=(0.0, 0.0, float(side)),
        origin=origin,
        limits=(0.0, angle),
        friction=HINGE_FRICTION,
        damping=HINGE_DAMPING,
    )


def make_bar_grasp(link: str, middle: Vec3, *, along: Literal["y", "z"], bar: float = BAR) -> Handle:
    """Return the grasp of a bar from the front, with approach direction -x.

    Args:
        link: name of the link with the bar.
        middle: centre of the bar, m.
        along: axis of the bar.
        bar: thickness of the bar, m.
    """
    closing = np.array([0.0, 1.0, 0.0]) if along == "z" else np.array([0.0, 0.0, 1.0])
    approach = np.array([-1.0, 0.0, 0.0])
    turn = Rotation.from_matrix(np.column_stack([np.cross(closing, approach), closing, approach]))
    x, y, z, w = (round(float(value), 9) for value in turn.as_quat())
    return Handle(link=link, position=middle, wxyz=(w, x, y, z), width=bar)


def make_surface(
    low: tuple[float, float], high: tuple[float, float], z: float, headroom: float | None = None, link: str = ""
) -> Surface:
    """Return a horizontal surface on which objects can be placed.

    Args:
        low: smallest x and y, m.
        high: largest x and y, m.
        z: height, m.
        headroom: free height above the surface, m, which is declared 1 mm smaller; None: nothing is above the surface.
        link: name of the moving part with the surface; empty: the fixed body.
    """
    room = None if headroom is None else round(headroom - 0.001, 6)
    return Surface(link=link, min_xy=low, max_xy=high, z=z, headroom=room)
