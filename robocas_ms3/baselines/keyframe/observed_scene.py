"""The scene as a policy observes it: a point cloud with classes, and its objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import Array

WIDE_RADIUS, NARROW_RADIUS = 0.035, 0.01
"""m within which votes for the centre of an object belong together; the narrow one tells touching copies apart, with
votes that are shrunk along the view (`shrink_along_view`)."""
_WORKSPACE = ((0.15, 1.15), (-0.9, 0.9), (-0.1, 0.6))  # m, least and greatest x, y and z in the arm's base frame
_TABLE_BINS = (-0.1, 0.6, 200)  # m, m, number of bins of the histogram of heights
_MAX_VOTES = 1200  # cells of an object that vote
_FARTHEST_VOTE = 2.0  # radii from the centre, beyond which a vote belongs to another object
_ALONG_VIEW = 0.15  # factor of distances along the view
_LEAST_SHARE = 0.1  # of the votes of the largest group; smaller groups are errors
_ABOVE_SUPPORT = (0.008, 0.12)  # m above a surface, within which points are on objects that stand on it
_BELOW = 0.02  # m below a camera, from which it sees the upper side of a surface
_TABLE_THICKNESS = 0.02  # m below the height of a surface, within which points are on it
_SUPPORT_MARGIN = 0.1  # m around the objects
_SUPPORT_POINTS, _LARGE_SUPPORT = 100, 300  # least number of points on a surface; number on a large one


def unproject(
    depth: NDArray, intrinsics: NDArray, camera_in_base: NDArray, pixels: tuple[NDArray, NDArray] | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the points (R, C, 3) of a depth image in the arm's base frame in m, and whether each is valid (R, C).

    Args:
        depth: (H, W) depth along the optical axis, mm; 0: no measurement.
        intrinsics: (3, 3) intrinsic matrix, pixels.
        camera_in_base: (4, 4) pose of the OpenCV camera frame in the arm's base frame.
        pixels: rows (R,) and columns (C,) of the image; None: all.
    """
    rows, columns = (np.arange(length) for length in depth.shape) if pixels is None else pixels
    meters = (depth if pixels is None else depth[np.ix_(rows, columns)]).astype(np.float64) / 1000
    x = (columns + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (rows + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    rotation, position = camera_in_base[:3, :3].astype(np.float64), camera_in_base[:3, 3].astype(np.float64)
    rays = x[None, :, None] * rotation[:, 0] + y[:, None, None] * rotation[:, 1] + rotation[:, 2]
    return rays * meters[..., None] + position, meters > 0


def sample_pixels(size: tuple[int, ...], step: int, first: int = 0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of an image with a size (H, W), every ``step`` pixels from the pixel ``first`` on."""
    return np.arange(first, size[0], step), np.arange(first, size[1], step)


def is_in_workspace(points: Array) -> NDArray[np.bool_]:
    """Return whether points (..., 3) are where the arm can reach objects."""
    low, high = np.array(_WORKSPACE).T
    return ((points > low) & (points < high)).all(axis=-1)


def is_below_camera(points: Array, camera_in_base: NDArray) -> NDArray[np.bool_]:
    """Return whether a camera can see the upper side of a horizontal surface at points (..., 3)."""
    return points[..., 2] < camera_in_base[2, 3] - _BELOW


def is_above_table(points: Array, table: float) -> NDArray[np.bool_]:
    """Return whether points (..., 3) are above a surface at the height ``table`` in m, or on it."""
    return points[..., 2] > table - _TABLE_THICKNESS


def find_table_height(others: Array, objects: Array) -> float:
    """Return the height of the surface on which objects stand, m.

    It is the height with the most object points up to 12 cm above it, weighted by s / (s + 300) for s surface points at
    this height. Objects on several layers: the height of the layer with the most object points. Too few surface points
    at all heights: the 2nd percentile of the heights of the object points.

    Args:
        others: (P, 3) points on no object and below the camera (`is_below_camera`), m.
        objects: (Q, 3) points on objects, m; without objects, the commonest height of all points is returned.
    """
    low, high, bins = _TABLE_BINS
    if len(objects):
        low_xy, high_xy = np.percentile(objects[:, :2], [2, 98], axis=0)
        near = (others[:, :2] > low_xy - _SUPPORT_MARGIN) & (others[:, :2] < high_xy + _SUPPORT_MARGIN)
        others = others[near.all(axis=1)]
    counts, edges = np.histogram(others[:, 2], bins=bins, range=(low, high))
    if not len(objects):
        return float(edges[counts.argmax()] + (high - low) / bins / 2)
    heights = np.sort(objects[:, 2])
    least, greatest = (np.searchsorted(heights, edges[:-1] + height) for height in _ABOVE_SUPPORT)
    is_surface = counts >= _SUPPORT_POINTS
    scores = is_surface * counts / (counts + _LARGE_SUPPORT) * (greatest - least)
    if not scores.any():
        return float(np.percentile(heights, 2))
    return float(edges[scores.argmax()] + (high - low) / bins / 2)


def cluster_votes(votes: Array, min_votes: int, radius: float) -> list[NDArray[np.int64]]:
    """Group votes (V, 3) for the centres of objects, the largest group first; return the indices of each group.

    The first centre is the mean of the votes within ``radius`` of the vote with the most neighbours; the votes within
    two radii of it are left out for the next one. Then each vote joins the nearest centre.

    Args:
        votes: (V, 3) predicted centres, m.
        min_votes: least number of votes of a group.
        radius: see `WIDE_RADIUS`, m.
    """
    remaining, centers = np.arange(len(votes)), list[Array]()
    if len(votes) > _MAX_VOTES:
        remaining = remaining[:: len(votes) // _MAX_VOTES + 1]
    least = max(1, min_votes * len(remaining) // max(len(votes), 1))
    while len(remaining) >= least:
        near = np.linalg.norm(votes[remaining][:, None] - votes[remaining][None], axis=2) < radius
        best = int(near.sum(axis=1).argmax())
        if near[best].sum() < least:
            break
        centers.append(votes[remaining[near[best]]].mean(axis=0))
        is_far = np.linalg.norm(votes[remaining] - centers[-1], axis=1) >= _FARTHEST_VOTE * radius
        if is_far.all():
            break
        remaining = remaining[is_far]
    if not centers:
        return []
    distances = np.linalg.norm(votes[:, None] - np.stack(centers)[None], axis=2)
    nearest = np.where(distances.min(axis=1) < 2 * WIDE_RADIUS, distances.argmin(axis=1), -1)
    groups = sorted((np.flatnonzero(nearest == number) for number in range(len(centers))), key=len, reverse=True)
    least = max(min_votes, _LEAST_SHARE * len(groups[0]))
    return [group for group in groups if len(group) >= least]


def shrink_along_view(votes: Array, camera: Array) -> Array:
    """Return votes (V, 3) for centres that are closer to each other along the view from a camera at (3,).

    Predicted centres are least certain along the view. This tells copies apart whose votes run into each other there.
    """
    view = (votes - camera).mean(axis=0)
    view /= np.linalg.norm(view)
    return votes - (1 - _ALONG_VIEW) * ((votes - votes.mean(axis=0)) @ view)[:, None] * view


@dataclass(frozen=True)
class ObservedObject:
    """An object in the point cloud.

    Attributes:
        mask: (P,) whether each point of the cloud is on the object.
        center: (3,) predicted centre in the arm's base frame, m.
        label: class of the object.
        probability: mean probability of its class.
    """

    mask: NDArray[np.bool_]
    center: Array
    label: int
    probability: float


@dataclass(frozen=True)
class ObservedScene:
    """Point cloud of one image with P points.

    Attributes:
        points: (P, 3) points in the arm's base frame, m.
        is_object: (P,) whether each point is on an object.
        targets: objects that may be the target.
        objects: all objects.
    """

    points: Array
    is_object: NDArray[np.bool_]
    targets: list[ObservedObject]
    objects: list[ObservedObject]
