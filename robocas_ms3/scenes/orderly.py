"""Orderly layouts: columns of alike objects from the front edge, side by side. Pure maths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import planar
from robocas_ms3.core.words import count_of
from robocas_ms3.scenes.placement import Array, PlaceableObject, Region

# Builtin products show their label to their own -y, and resting poses have no yaw of their own, so that in every one
# the label looks to -y of the plane or up, text upright for someone who stands at -y.
_LABEL_YAW = -np.pi / 2


def sample_orderly(
    rng: np.random.Generator,
    placeables: list[PlaceableObject],
    columns: list[str],
    region: Region,
    *,
    front: Array,
    row_gap: float,
    column_spacing: float = 1.3,
    yaw_jitter: float = 0.0,
    turn_columns: bool = False,
    keep_what_fits: bool = False,
) -> tuple[Array, NDArray[np.bool_]]:
    """Stand objects in columns that begin at the front edge, labels to the front.

    All objects stand in their display pose, or, where there is none, in the most probable one. Neighbouring columns
    are as far apart as the mean of their widths times ``column_spacing``. What is drawn: the order of the columns,
    those of one kind of object staying together, and where in the free room along the edge the block stands.

    Args:
        rng: source of all randomness.
        placeables: the objects.
        columns: the column of each object; those of a column stand one behind the other in the order given.
        region: rectangle that holds every footprint.
        front: (2,) unit vector along an axis of the region's frame, out of the front edge.
        row_gap: between objects of a column, m.
        column_spacing: at least 1 (upstream: 1.3).
        yaw_jitter: greatest turn of each object, rad.
        turn_columns: each column by any angle, all its objects alike.
        keep_what_fits: leave out the first column that doesn't fit, all after it, and objects behind the region.

    Returns:
        (K, 4, 4) objects in the region's frame, in the order of ``placeables``; (K,) which of them there is room for.

    Raises:
        LayoutError: the columns don't fit side by side, or one is too long; or nothing fits at all.
    """
    ahead = np.asarray(front, dtype=float)
    along = np.array([-ahead[1], ahead[0]])  # the front edge's own direction
    yaws = np.arctan2(ahead[1], ahead[0]) - _LABEL_YAW + rng.uniform(-yaw_jitter, yaw_jitter, len(placeables))
    if turn_columns:
        turns = {column: rng.uniform(-np.pi, np.pi) for column in dict.fromkeys(columns)}
        yaws += [turns[column] for column in columns]
    choices = [_standing(placeable) for placeable in placeables]
    low, high = np.zeros((len(placeables), 2)), np.zeros((len(placeables), 2))  # extents along the edge, and ahead
    for i, (placeable, choice, yaw) in enumerate(zip(placeables, choices, yaws, strict=True)):
        turned = placeable.footprints[choice] @ planar(0, 0, 0, yaw)[:2, :2].T @ np.column_stack([along, ahead])
        low[i], high[i] = turned.min(axis=0), turned.max(axis=0)

    members = _ordered(rng, placeables, columns)
    widths = np.array([max(high[i, 0] - low[i, 0] for i in column) for column in members])
    centers = np.concatenate([[0.0], np.cumsum(column_spacing * (widths[1:] + widths[:-1]) / 2)])
    taken = centers + (widths[0] + widths) / 2  # by the columns up to each
    corners = np.array([region.min_xy, region.max_xy]) @ np.column_stack([along, ahead])
    (left, back), (right, edge) = corners.min(axis=0), corners.max(axis=0)
    count = int((taken <= right - left).sum()) if keep_what_fits else len(members)
    if count == 0 or taken[count - 1] > right - left:
        raise _does_not_fit(f"{count_of(len(members), 'column')} side by side", taken[count - 1], right - left)
    start = left + widths[0] / 2 + rng.uniform() * (right - left - taken[count - 1])

    poses, there = np.tile(np.eye(4), (len(placeables), 1, 1)), np.zeros(len(placeables), dtype=bool)
    for column, center in zip(members[:count], start + centers[:count], strict=True):
        free = edge  # what is left of the column begins here
        for i in column:
            x, y = (center - (low[i, 0] + high[i, 0]) / 2) * along + (free - high[i, 1]) * ahead
            poses[i] = planar(x, y, region.z, yaws[i]) @ placeables[i].resting_poses[choices[i]]
            free -= high[i, 1] - low[i, 1] + row_gap
            depth = edge - free - row_gap
            there[i] = depth <= edge - back
        if not there[column].all() and not keep_what_fits:
            raise _does_not_fit(f"{len(column)} x {placeables[column[0]].name} in a column", depth, edge - back)
    if not there.any():
        raise _does_not_fit("even the first objects of the columns", min(high[:, 1] - low[:, 1]), edge - back)
    return poses, there


def _ordered(rng: np.random.Generator, placeables: list[PlaceableObject], columns: list[str]) -> list[list[int]]:
    """The objects of each column, in the order of the columns along the edge: kinds are shuffled."""
    kinds: dict[str, dict[str, list[int]]] = {}
    for i, (placeable, column) in enumerate(zip(placeables, columns, strict=True)):
        kinds.setdefault(placeable.name, {}).setdefault(column, []).append(i)
    names = list(kinds)
    return [column for k in rng.permutation(len(names)) for column in kinds[names[k]].values()]


def _standing(placeable: PlaceableObject) -> int:
    if placeable.display_pose >= 0:
        return placeable.display_pose
    return int(np.argmax(placeable.probabilities))


def _does_not_fit(what: str, needed: float, room: float) -> LayoutError:
    return LayoutError(
        f"{what} don't fit on the surface",
        where="layout",
        expected=f"at most {room:.2f} m",
        found=f"{needed:.2f} m",
        fix="Lower objects.count, layout.rows, layout.copies or layout.column_spacing, or enlarge the surface.",
    )
