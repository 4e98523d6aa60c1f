"""Layouts: where objects stand on a surface. Pure maths, no simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from robocas_ms3.errors import LayoutError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Placeable:
    """What a layout has to know of one object.

    Attributes:
        name: for messages.
        resting_poses: (S, 4, 4) object in a frame whose z = 0 is the support and whose origin lies below the object's
            centre of mass, m.
        probabilities: (S,) how often the object comes to rest so; any positive scale.
        footprints: S convex polygons (K, 2): the object's outline from above in each resting pose, m.
    """

    name: str
    resting_poses: Array
    probabilities: Array
    footprints: list[Array]


@dataclass(frozen=True)
class Region:
    """An upright rectangle on a horizontal surface, in the frame of the furniture it belongs to, m."""

    min_xy: tuple[float, float]
    max_xy: tuple[float, float]
    z: float


def planar_pose(x: float, y: float, z: float, yaw: float) -> Array:
    """4x4 of a turn by ``yaw`` (rad) about the vertical, then a shift (m)."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def sample_scattered(
    rng: np.random.Generator, placeables: list[Placeable], region: Region, *, min_gap: float, max_tries: int
) -> Array:
    """Place objects apart from each other, each in one of its resting poses at a random yaw.

    Big objects are placed first, since they are the hard ones; when one finds no room, the layout starts over.

    Args:
        rng: source of all randomness.
        placeables: the objects.
        region: rectangle that holds every footprint.
        min_gap: least distance between two footprints, m.
        max_tries: positions tried in all before giving up.

    Returns:
        (K, 4, 4) objects in the region's frame, in the order of ``placeables``.

    Raises:
        LayoutError: the objects don't fit.
    """
    size = np.subtract(region.max_xy, region.min_xy)
    tries_per_object = 40
    tries = 0
    while tries < max_tries:
        poses = np.zeros((len(placeables), 4, 4))
        choices = [_choose_pose(rng, placeable) for placeable in placeables]
        areas = [shapely.Polygon(p.footprints[c]).area for p, c in zip(placeables, choices, strict=True)]
        placed: list[shapely.Polygon] = []
        for index in np.argsort(areas)[::-1]:
            placeable, choice = placeables[index], choices[index]
            for _ in range(tries_per_object):
                tries += 1
                yaw = rng.uniform(-np.pi, np.pi)
                outline = placeable.footprints[choice] @ planar_pose(0, 0, 0, yaw)[:2, :2].T
                low, high = outline.min(axis=0), outline.max(axis=0)
                free = size - (high - low)
                if (free < 0).any():
                    continue
                position = np.add(region.min_xy, rng.uniform(0, 1, 2) * free) - low
                polygon = shapely.Polygon(outline + position)
                if placed and shapely.distance(polygon, placed).min() < min_gap:
                    continue
                placed.append(polygon)
                poses[index] = planar_pose(position[0], position[1], region.z, yaw) @ placeable.resting_poses[choice]
                break
            else:
                break  # no room for this one: start over
        if len(placed) == len(placeables):
            return poses
    raise LayoutError(
        f"{len(placeables)} objects don't fit {min_gap * 100:.1f} cm apart on {size[0]:.2f} x {size[1]:.2f} m",
        where="layout",
        found=f"{max_tries} tries used up",
        fix="Lower objects.count or layout.min_gap, enlarge the surface, or raise layout.max_tries.",
    )


def _choose_pose(rng: np.random.Generator, placeable: Placeable) -> int:
    weights = np.asarray(placeable.probabilities, dtype=float)
    return int(rng.choice(len(weights), p=weights / weights.sum()))


def choose_objects(rng: np.random.Generator, ids: list[str], count: int) -> list[str]:
    """Draw ``count`` ids: each at most once, unless there are fewer ids than that; then as evenly as can be."""
    chosen: list[str] = []
    while len(chosen) < count:
        order = [ids[i] for i in rng.permutation(len(ids))]
        chosen += order[: count - len(chosen)]
    return chosen


def choose_target(
    rng: np.random.Generator, names: list[str], positions_xy: Array, eligible: NDArray[np.bool_], robot_xy: Array
) -> int | None:
    """Draw the target of a pick among the eligible objects.

    An instruction names the target by its name alone, so among objects of the drawn name the one nearest the robot is
    meant; if that one isn't eligible, the name isn't drawn.

    Args:
        rng: source of all randomness.
        names: K names.
        positions_xy: (K, 2) m.
        eligible: (K,) which objects can be grasped and reached.
        robot_xy: (2,) m, same frame.

    Returns:
        Index of the target; None if no object qualifies.
    """
    distances = np.linalg.norm(np.asarray(positions_xy) - robot_xy, axis=1)
    nearest = {}
    for index in np.argsort(distances, kind="stable"):
        nearest.setdefault(names[index], int(index))
    candidates = sorted(index for index in nearest.values() if eligible[index])
    return int(rng.choice(candidates)) if candidates else None
