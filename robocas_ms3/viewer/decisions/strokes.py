"""Lines that show a candidate: gripper forks for grasps, arrows for motions, circles for releases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import from_wxyz, transform_points

Array = NDArray[np.float64]

_HALF_WIDTH = 0.04  # m, of the open gripper
_FINGER, _STEM = 0.045, 0.04  # m, lengths of the lines of fingers and hand
_BEYOND_TCP = 0.01  # m, from the TCP to the ends of the fingers
_RADIUS = 0.025  # m, of the circle of a release


@dataclass(frozen=True)
class Stroke:
    """Line of a candidate.

    Attributes:
        points: (P, 3) points in the arm's base frame, m.
        arrow: whether the line ends in an arrow head.
        dashed: whether the line is dashed.
    """

    points: Array
    arrow: bool = False
    dashed: bool = False


def make_strokes(primitive: str, start: NDArray, end: NDArray) -> list[Stroke]:
    """Return the lines of a candidate.

    A grasp is a gripper fork, a push or pull an arrow, a lift a fork and a dashed arrow to the placement, and a release
    a circle.

    Args:
        primitive: one of `schema.PRIMITIVES`.
        start: TCP pose (7,) at the grasp, at the release, or at the start of the motion; NaN: unknown.
        end: TCP pose (7,) at the end of the motion; NaN: unknown.
    """
    if not np.isfinite(start).all():
        return []
    path = np.array([start[:3], end[:3]], np.float64)
    has_end = bool(np.isfinite(path).all())
    if primitive == "release":
        return [Stroke(_circle(path[0]))]
    if primitive in ("push", "pull"):
        return [Stroke(path, arrow=True)] if has_end else []
    fork = [Stroke(points) for points in _fork(start)]
    return [*fork, Stroke(path, arrow=True, dashed=True)] if primitive == "lift" and has_end else fork


def _fork(tcp_in_base: NDArray) -> list[Array]:
    """Return the lines of an open gripper at a TCP pose (7,): fingers and palm, and hand."""
    y, back = _HALF_WIDTH, _BEYOND_TCP - _FINGER
    fingers = np.array([[0, -y, _BEYOND_TCP], [0, -y, back], [0, y, back], [0, y, _BEYOND_TCP]])
    hand = np.array([[0, 0, back], [0, 0, back - _STEM]])
    pose = from_wxyz(np.asarray(tcp_in_base, np.float64))
    return [transform_points(pose, fingers), transform_points(pose, hand)]


def _circle(centre: Array) -> Array:
    angles = np.linspace(0, 2 * np.pi, 17)
    return centre + _RADIUS * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
