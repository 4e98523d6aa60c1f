"""Layouts: where objects stand on a surface. Pure maths, no simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import planar
from robocas_ms3.core.words import count_of

Array = NDArray[np.float64]

_TIGHT = 0.3  # share of the tries after which objects are packed rather than strewn
_TRIES_AT_ONCE = 40  # positions of one object before the layout starts over


@dataclass(frozen=True)
class PlaceableObject:
    """What a layout has to know of one object.

    Attributes:
        name: for messages.
        resting_poses: (S, 4, 4) object in a frame whose z = 0 is the support and whose origin lies below the object's
            centre of mass, m.
        probabilities: (S,) how often the object comes to rest so; any positive scale.
        footprints: S convex polygons (K, 2): the object's outline from above in each resting pose, m.
        display_pose: index of the resting pose in which it stands upright, or -1.
    """

    name: str
    resting_poses: Array
    probabilities: Array
    footprints: list[Array]
    display_pose: int = -1


@dataclass(frozen=True)
class Region:
    """An upright rectangle on a horizontal surface, in the frame of the furniture it belongs to, m."""

    min_xy: tuple[float, float]
    max_xy: tuple[float, float]
    z: float


def sample_scattered(
    rng: np.random.Generator, placeables: list[PlaceableObject], region: Region, *, min_gap: float, max_tries: int
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
    tries = 0
    all_areas = [np.array([shapely.Polygon(footprint).area for footprint in p.footprints]) for p in placeables]
    while tries < max_tries:
        poses = np.zeros((len(placeables), 4, 4))
        # Where it gets tight, objects rather stand than lie: of several poses drawn, the one covering least is taken.
        tightness = tries / max_tries
        draws = 1 + int(8 * tightness)
        choices = [_choose_pose(rng, p, areas, draws) for p, areas in zip(placeables, all_areas, strict=True)]
        placed: list[shapely.Polygon] = []
        for index in np.argsort([areas[c] for areas, c in zip(all_areas, choices, strict=True)])[::-1]:
            placeable, choice = placeables[index], choices[index]
            tries += _TRIES_AT_ONCE
            yaws, positions, outlines = _candidates(rng, placeable.footprints[choice], region)
            if placed and len(yaws):
                free = ~shapely.dwithin(np.array(placed), outlines[:, None], min_gap).any(axis=1)
                yaws, positions, outlines = (values[free] for values in (yaws, positions, outlines))
            if not len(yaws):
                break  # no room for this one: start over
            # and they rather stand in a corner or close to each other than anywhere, so that room is left for the rest
            best = 0 if tightness < _TIGHT else _snuggest(outlines, placed, region)
            shapely.prepare(outlines[best])
            placed.append(outlines[best])
            x, y = positions[best]
            poses[index] = planar(x, y, region.z, yaws[best]) @ placeable.resting_poses[choice]
        if len(placed) == len(placeables):
            return poses
    size, things = np.subtract(region.max_xy, region.min_xy), count_of(len(placeables), "object")
    raise LayoutError(
        f"no room for {things} {min_gap * 100:.1f} cm apart on {size[0]:.2f} x {size[1]:.2f} m",
        where="layout",
        found=f"{max_tries} tries used up",
        fix="Lower objects.count or layout.min_gap, enlarge the surface, or raise layout.max_tries.",
    )


def _snuggest(outlines: NDArray, placed: list[shapely.Polygon], region: Region) -> int:
    """The outline that is nearest to its two nearest neighbours, the region's edges being neighbours too."""
    low, high = shapely.bounds(outlines)[:, :2], shapely.bounds(outlines)[:, 2:]
    gaps = [low - region.min_xy, np.subtract(region.max_xy, high)]
    if placed:
        gaps.append(shapely.distance(outlines[:, None], np.array(placed)[None]))
    return int(np.sort(np.concatenate(gaps, axis=1), axis=1)[:, :2].sum(axis=1).argmin())


def _candidates(rng: np.random.Generator, footprint: Array, region: Region) -> tuple[Array, Array, NDArray]:
    """Random yaws (n,), positions (n, 2) and outlines (n,) of a footprint inside a region; fewer where it is narrow."""
    yaws = rng.uniform(-np.pi, np.pi, _TRIES_AT_ONCE)
    shares = rng.uniform(0, 1, (_TRIES_AT_ONCE, 2))
    cos, sin = np.cos(yaws), np.sin(yaws)
    turned = np.einsum("nij,kj->nki", np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], 1), footprint)
    low, high = turned.min(axis=1), turned.max(axis=1)
    free = np.subtract(region.max_xy, region.min_xy) - (high - low)
    positions = np.add(region.min_xy, shares * free) - low
    fits = (free >= 0).all(axis=1)
    return yaws[fits], positions[fits], shapely.polygons((turned + positions[:, None])[fits])


def _choose_pose(rng: np.random.Generator, placeable: PlaceableObject, areas: Array, draws: int) -> int:
    weights = np.asarray(placeable.probabilities, dtype=float)
    drawn = rng.choice(len(weights), size=draws, p=weights / weights.sum())
    return int(drawn[np.argmin(areas[drawn])])


def choose_objects(rng: np.random.Generator, ids: list[str], count: int, *, repeats: bool = False) -> list[str]:
    """Draw ``count`` ids: each at most once, unless there are fewer ids than that; then as evenly as can be.

    With ``repeats`` each is drawn from all of them.
    """
    if repeats:
        return [ids[i] for i in rng.integers(len(ids), size=count)]
    chosen: list[str] = []
    while len(chosen) < count:
        order = [ids[i] for i in rng.permutation(len(ids))]
        chosen += order[: count - len(chosen)]
    return chosen
