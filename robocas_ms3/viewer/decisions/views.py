"""Views of a decision: cameras, and a plot from above that needs no images. They project lines to pixels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import inverse, transform_points
from robocas_ms3.viewer.decisions.strokes import Stroke

Array = NDArray[np.float64]
Region = tuple[float, float, float, float]
"""Left, top, width and height of a part of an image, pixels."""

TOP_VIEW = "top_view"
"""Name of the plot from above."""
_NEAREST = 0.05  # m; nearer points are behind a camera, or distorted
_HEAD = 0.018  # m, length of an arrow head
_HEAD_ANGLE = np.radians(28)
_ASPECT = 4 / 3
_MARGIN = 0.15  # around the content of a region, as a fraction of its size
_SMALLEST = 0.2  # smallest width of a region as a fraction of the image's width
_TOP_SIZE = (640, 480)
_TOP_MARGIN = 0.12  # m, around the content of the plot from above


class View(ABC):
    """Projection of points in the arm's base frame to pixels; (0, 0) is the top left corner of the image.

    Attributes:
        name: name of the camera, or `TOP_VIEW`.
        size: width and height in pixels.
    """

    name: str
    size: tuple[int, int]

    @abstractmethod
    def project(self, points: Array) -> tuple[Array, Array]:
        """Project points (P, 3) in m; return pixels (P, 2), and pixels per metre (P,), NaN for invisible points."""


@dataclass(frozen=True)
class CameraView(View):
    """View of a camera.

    Attributes:
        intrinsic: (4,) fx, fy, cx, cy in pixels.
        camera_in_base: (4, 4) pose of the OpenCV camera frame in the arm's base frame.
    """

    name: str
    size: tuple[int, int]
    intrinsic: Array
    camera_in_base: Array

    def project(self, points: Array) -> tuple[Array, Array]:
        x, y, z = transform_points(inverse(self.camera_in_base), points).T
        z = np.where(z > _NEAREST, z, np.nan)
        fx, fy, cx, cy = self.intrinsic
        return np.stack([fx * x / z + cx, fy * y / z + cy], axis=1), fx / z


@dataclass(frozen=True)
class TopView(View):
    """Orthographic view from above: x of the base frame points up, y to the left.

    Attributes:
        centre: x and y at the centre of the image, m.
        scale: pixels per metre.
    """

    centre: tuple[float, float]
    scale: float
    name: str = TOP_VIEW
    size: tuple[int, int] = _TOP_SIZE

    def project(self, points: Array) -> tuple[Array, Array]:
        columns = self.size[0] / 2 - self.scale * (points[:, 1] - self.centre[1])
        rows = self.size[1] / 2 - self.scale * (points[:, 0] - self.centre[0])
        return np.stack([columns, rows], axis=1), np.full(len(points), self.scale)


def make_top_view(points: Array) -> TopView:
    """Return a view from above that shows all points (P, 3)."""
    low, high = points[:, :2].min(axis=0) - _TOP_MARGIN, points[:, :2].max(axis=0) + _TOP_MARGIN
    x, y = (low + high) / 2
    scale = min(_TOP_SIZE[1] / (high[0] - low[0]), _TOP_SIZE[0] / (high[1] - low[1]))
    return TopView((float(x), float(y)), float(scale))


def project_stroke(view: View, stroke: Stroke) -> list[Array]:
    """Return the lines (P, 2) of a stroke in pixels, with its arrow head; [] if a part is behind the camera."""
    pixels, scale = view.project(stroke.points)
    if not np.isfinite(pixels).all():
        return []
    if not stroke.arrow:
        return [pixels]
    back = pixels[-2] - pixels[-1]
    length = float(np.linalg.norm(back))
    if length == 0:
        return [pixels]
    size = min(_HEAD * scale[-1], 0.6 * length)
    barbs = [pixels[-1] + size * _rotate(back / length, angle) for angle in (-_HEAD_ANGLE, _HEAD_ANGLE)]
    return [pixels, np.array([barbs[0], pixels[-1], barbs[1]])]


def find_region(view: View, points: Sequence[Array]) -> Region:
    """Return the part of an image, with an aspect ratio of 4:3, that contains the given pixels (P, 2) and a margin.

    Pixels outside the image do not count. Without pixels in the image, the region is the whole image.
    """
    width, height = view.size
    found = np.concatenate([np.empty((0, 2)), *points])
    found = found[np.isfinite(found).all(axis=1)]
    found = found[((found >= 0) & (found <= view.size)).all(axis=1)]
    if not len(found):
        return 0.0, 0.0, float(width), float(height)
    low, high = found.min(axis=0), found.max(axis=0)
    wide = max((high[0] - low[0]) * (1 + 2 * _MARGIN), (high[1] - low[1]) * (1 + 2 * _MARGIN) * _ASPECT)
    wide = min(max(wide, _SMALLEST * width), width, height * _ASPECT)
    box = np.array([wide, wide / _ASPECT])
    corner = np.clip((low + high) / 2 - box / 2, 0, np.array(view.size) - box)
    return float(corner[0]), float(corner[1]), float(box[0]), float(box[1])


def _rotate(vector: Array, angle: float) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])
