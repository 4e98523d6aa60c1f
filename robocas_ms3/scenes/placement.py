"""Place objects on a surface, scattered or in columns. No simulator."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import from_xyz_yaw
from robocas_ms3.core.text import format_count
from robocas_ms3.scenes.config.task import OrderlyLayout, ScatteredLayout

Array = NDArray[np.float64]

_TIGHT = 0.3  # fraction of the tries after which objects are packed close together
_TRIES_AT_ONCE = 40  # positions tried per object before the layout starts again
# The label of a bundled product is on its -y side, and resting poses have no yaw. So the label always points to -y of
# the plane or up, and its text is upright for a viewer at -y.
_LABEL_YAW = -np.pi / 2


@dataclass(frozen=True)
class PlaceableObject:
    """Object to place on a surface.

    Attributes:
        name: kind of the object; objects of one kind have equal names.
        resting_poses: (S, 4, 4), as in `assets.annotations.Annotations`.
        probabilities: (S,) probability of each resting pose.
        footprints: corners (K, 2) of the footprint in each resting pose, m.
        display_pose: index of the upright resting pose, or -1.
    """

    name: str
    resting_poses: Array
    probabilities: Array
    footprints: list[Array]
    display_pose: int = -1


@dataclass(frozen=True)
class Region:
    """Axis-aligned rectangle on a horizontal surface of furniture, in the frame of the furniture, m."""

    min_xy: tuple[float, float]
    max_xy: tuple[float, float]
    z: float


def sample_scattered(
    rng: np.random.Generator, placeables: list[PlaceableObject], region: Region, layout: ScatteredLayout
) -> Array:
    """Draw poses of objects that do not touch each other, each in a random resting pose with a random yaw.

    Large objects are placed first. If there is no free position for an object, all objects are placed again.

    Args:
        rng: random generator.
        placeables: K objects.
        region: rectangle that contains all footprints.
        layout: least distance between objects, and number of tries.

    Returns:
        (K, 4, 4) poses of the objects in the region's frame, in the order of ``placeables``.

    Raises:
        LayoutError: the objects don't fit.
    """
    tries, max_tries, min_gap = 0, layout.max_tries, layout.min_gap
    all_areas = [np.array([shapely.Polygon(footprint).area for footprint in p.footprints]) for p in placeables]
    while tries < max_tries:
        poses = np.zeros((len(placeables), 4, 4))
        # When space is short, objects stand rather than lie: the pose with the smallest footprint of several is used.
        tightness = tries / max_tries
        draws = 1 + int(8 * tightness)
        choices = [_choose_pose(rng, p, areas, draws) for p, areas in zip(placeables, all_areas, strict=True)]
        placed: list[shapely.Polygon] = []
        for index in np.argsort([areas[c] for areas, c in zip(all_areas, choices, strict=True)])[::-1]:
            placeable, choice = placeables[index], choices[index]
            tries += _TRIES_AT_ONCE
            yaws, positions, outlines = _draw_candidates(rng, placeable.footprints[choice], region)
            if placed and len(yaws):
                free = ~shapely.dwithin(np.array(placed), outlines[:, None], min_gap).any(axis=1)
                yaws, positions, outlines = (values[free] for values in (yaws, positions, outlines))
            if not len(yaws):
                break  # no free position: start again
            # and they are placed in corners or close to each other, which leaves room for the rest
            best = 0 if tightness < _TIGHT else _find_tightest(outlines, placed, region)
            shapely.prepare(outlines[best])
            placed.append(outlines[best])
            x, y = positions[best]
            poses[index] = from_xyz_yaw(x, y, region.z, yaws[best]) @ placeable.resting_poses[choice]
        if len(placed) == len(placeables):
            return poses
    size, things = np.subtract(region.max_xy, region.min_xy), format_count(len(placeables), "object")
    raise LayoutError(
        f"{things}, {min_gap * 100:.1f} cm apart, do not fit on {size[0]:.2f} x {size[1]:.2f} m",
        where="layout",
        found=f"{max_tries} tries without a layout",
        fix="Lower objects.count or layout.min_gap, enlarge the surface, or raise layout.max_tries.",
    )


def _find_tightest(outlines: NDArray, placed: list[shapely.Polygon], region: Region) -> int:
    """Return the index of the outline with the least free space around it.

    Free space is the sum of the distances to the two nearest objects or edges of the region.
    """
    low, high = shapely.bounds(outlines)[:, :2], shapely.bounds(outlines)[:, 2:]
    gaps = [low - region.min_xy, np.subtract(region.max_xy, high)]
    if placed:
        gaps.append(shapely.distance(outlines[:, None], np.array(placed)[None]))
    return int(np.sort(np.concatenate(gaps, axis=1), axis=1)[:, :2].sum(axis=1).argmin())


def _draw_candidates(rng: np.random.Generator, footprint: Array, region: Region) -> tuple[Array, Array, NDArray]:
    """Draw n poses of a footprint inside a region: yaws (n,), positions (n, 2) and polygons (n,)."""
    yaws = rng.uniform(-np.pi, np.pi, _TRIES_AT_ONCE)
    fractions = rng.uniform(0, 1, (_TRIES_AT_ONCE, 2))
    cos, sin = np.cos(yaws), np.sin(yaws)
    turned = np.einsum("nij,kj->nki", np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], 1), footprint)
    low, high = turned.min(axis=1), turned.max(axis=1)
    free = np.subtract(region.max_xy, region.min_xy) - (high - low)
    positions = np.add(region.min_xy, fractions * free) - low
    fits = (free >= 0).all(axis=1)
    return yaws[fits], positions[fits], shapely.polygons((turned + positions[:, None])[fits])


def _choose_pose(rng: np.random.Generator, placeable: PlaceableObject, areas: Array, draws: int) -> int:
    weights = np.asarray(placeable.probabilities, dtype=float)
    drawn = rng.choice(len(weights), size=draws, p=weights / weights.sum())
    return int(drawn[np.argmin(areas[drawn])])


def sample_orderly(
    rng: np.random.Generator, placeables: list[PlaceableObject], region: Region, layout: OrderlyLayout, front: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Draw poses of objects in columns that start at the front edge of a region, with labels to the front.

    An object is in its display pose or, if it has none, in its most probable resting pose. The distance of two
    neighbouring columns is ``column_spacing`` times the mean of their widths. The random generator decides the order of
    the kinds (columns of one kind stay together), and the position of all columns along the edge.

    Args:
        rng: random generator.
        placeables: K objects.
        region: rectangle that contains all footprints.
        layout: sizes of columns and gaps. With ``keep_what_fits``, the first column that doesn't fit, all columns after
            it, and objects beyond the back of the region are left out.
        front: (2,) unit vector in the region's frame, along an axis, that points out of the front edge.

    Returns:
        (K, 4, 4) poses of the objects in the region's frame, in the order of ``placeables``. (K,) bool, whether there
        is room for each object.

    Raises:
        LayoutError: the columns don't fit side by side, a column is too long, or no object fits.
    """
    columns = _assign_columns(placeables, layout.rows)
    along = np.array([-front[1], front[0]])  # direction of the front edge
    jitter = np.deg2rad(layout.yaw_jitter_deg)
    yaws = np.arctan2(front[1], front[0]) - _LABEL_YAW + rng.uniform(-jitter, jitter, len(placeables))
    if layout.column_yaw == "random":
        turns = {column: rng.uniform(-np.pi, np.pi) for column in dict.fromkeys(columns)}
        yaws += [turns[column] for column in columns]
    choices = [p.display_pose if p.display_pose >= 0 else int(np.argmax(p.probabilities)) for p in placeables]
    low, high = np.zeros((len(placeables), 2)), np.zeros((len(placeables), 2))  # extents along the edge, and ahead
    for i, (placeable, choice, yaw) in enumerate(zip(placeables, choices, yaws, strict=True)):
        turned = placeable.footprints[choice] @ from_xyz_yaw(0, 0, 0, yaw)[:2, :2].T @ np.column_stack([along, front])
        low[i], high[i] = turned.min(axis=0), turned.max(axis=0)

    members = _shuffle_kinds(rng, columns)
    widths = np.array([max(high[i, 0] - low[i, 0] for i in column) for column in members])
    centers = np.concatenate([[0.0], np.cumsum(layout.column_spacing * (widths[1:] + widths[:-1]) / 2)])
    taken = centers + (widths[0] + widths) / 2  # by the columns up to each
    corners = np.array([region.min_xy, region.max_xy]) @ np.column_stack([along, front])
    (left, back), (right, edge) = corners.min(axis=0), corners.max(axis=0)
    count = int((taken <= right - left).sum()) if layout.keep_what_fits else len(members)
    if count == 0 or taken[count - 1] > right - left:
        raise _make_size_error(f"{format_count(len(members), 'column')} side by side", taken[count - 1], right - left)
    start = left + widths[0] / 2 + rng.uniform() * (right - left - taken[count - 1])

    poses, there = np.tile(np.eye(4), (len(placeables), 1, 1)), np.zeros(len(placeables), dtype=bool)
    for column, center in zip(members[:count], start + centers[:count], strict=True):
        free = edge  # start of the free part of the column
        for i in column:
            x, y = (center - (low[i, 0] + high[i, 0]) / 2) * along + (free - high[i, 1]) * front
            poses[i] = from_xyz_yaw(x, y, region.z, yaws[i]) @ placeables[i].resting_poses[choices[i]]
            free -= high[i, 1] - low[i, 1] + layout.row_gap
            depth = edge - free - layout.row_gap
            there[i] = depth <= edge - back
        if not there[column].all() and not layout.keep_what_fits:
            raise _make_size_error(f"{len(column)} x {placeables[column[0]].name} in a column", depth, edge - back)
    if not there.any():
        raise _make_size_error("the first objects of all columns", min(high[:, 1] - low[:, 1]), edge - back)
    return poses, there


def _assign_columns(placeables: list[PlaceableObject], rows: int) -> list[tuple[str, int]]:
    """Return the column (kind, index within the kind) of each object.

    A column has at most ``rows`` objects.
    """
    seen: Counter[str] = Counter()
    columns = []
    for placeable in placeables:
        columns.append((placeable.name, seen[placeable.name] // rows))
        seen[placeable.name] += 1
    return columns


def _shuffle_kinds(rng: np.random.Generator, columns: list[tuple[str, int]]) -> list[list[int]]:
    """Return the indices of the objects of each column, with the columns in a random order of their kinds."""
    kinds: dict[str, dict[int, list[int]]] = {}
    for i, (kind, number) in enumerate(columns):
        kinds.setdefault(kind, {}).setdefault(number, []).append(i)
    names = list(kinds)
    return [column for k in rng.permutation(len(names)) for column in kinds[names[k]].values()]


def _make_size_error(what: str, needed: float, room: float) -> LayoutError:
    return LayoutError(
        f"{what} don't fit on the surface",
        where="layout",
        expected=f"at most {room:.2f} m",
        found=f"{needed:.2f} m",
        fix="Lower objects.count, layout.rows, layout.copies or layout.column_spacing, or enlarge the surface.",
    )


def draw_object_ids(rng: np.random.Generator, ids: list[str], count: int, *, repeats: bool = False) -> list[str]:
    """Draw ``count`` object ids.

    Args:
        rng: random generator.
        ids: ids to draw from.
        count: number of drawn ids.
        repeats: whether each id is drawn independently of the others. False: an id is drawn again only after all ids
            have been drawn equally often.
    """
    if repeats:
        return [ids[i] for i in rng.integers(len(ids), size=count)]
    chosen: list[str] = []
    while len(chosen) < count:
        order = [ids[i] for i in rng.permutation(len(ids))]
        chosen += order[: count - len(chosen)]
    return chosen
