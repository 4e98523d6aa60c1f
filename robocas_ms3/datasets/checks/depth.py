"""Check that depth images agree with the intrinsics and poses of the cameras.

Three rules hold in any scene; wrong poses, intrinsics, axes or units violate at least one of them:

- No point is below the floor. Horizontal surfaces near the floor are the floor, except bottoms of furniture, which the
  gripper camera sees.
- No camera measures a depth behind a surface that another camera sees.
- All cameras see the workspace, so at some step the depth of each camera agrees with the depth of another camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import inverse

Array = NDArray[np.float64]

POINT_ROWS = 80  # rows of pixels that are compared
JUMP = 0.2  # m between neighbouring points of different surfaces
MIN_POINTS = 100  # fewer points are not significant
FLOOR_TOLERANCE = 0.03  # m
FLOOR_BAND = 0.15  # m; horizontal surfaces within it count as floor
HORIZONTAL = np.cos(
    np.deg2rad(20)
)  # largest angle between surface normal and vertical; excludes the lower edge of a wall
SEEN_THROUGH = 0.05  # fraction of points
AGREEING = 0.1  # fraction of points, at the best step and with the best camera; the other points may be hidden
NEAR = 0.15  # m; at smaller depth a pixel covers less than 1 mm, the resolution of depth


@dataclass(frozen=True)
class DepthView:
    """Depth image of a camera at one step, with intrinsics and pose.

    Attributes:
        camera: name of the camera.
        depth: (H, W) in mm, 0 = no depth.
        intrinsic: (4,) fx, fy, cx, cy in pixels.
        camera_in_world: (4, 4) pose of the OpenCV camera frame.
        on_gripper: whether it is the gripper camera, which sees the inside of furniture.
    """

    camera: str
    depth: NDArray[np.uint16]
    intrinsic: Array
    camera_in_world: Array
    on_gripper: bool = False

    def points(self) -> Array:
        """Return the visible points (N, 3) in the world frame, m; large images are subsampled."""
        grid, known = self._compute_grid()
        return grid[known]

    def edge_distances(self) -> Array:
        """Return the distance (N,) in m from each of the `points` to the nearest visible edge of its surface.

        The inverse depth of a plane is linear in the pixel coordinates. A pixel is an edge if its inverse depth differs
        from the mean of its neighbours.
        """
        z = self.depth.astype(np.float64) / 1000
        inverse = np.divide(1, z, out=np.zeros_like(z), where=z > 0)
        padded = np.pad(inverse, 1, mode="edge")
        bends = [
            np.abs(padded[:-2, 1:-1] + padded[2:, 1:-1] - 2 * inverse),
            np.abs(padded[1:-1, :-2] + padded[1:-1, 2:] - 2 * inverse),
        ]
        smooth = (z > 0) & (np.maximum(*bends) * z**2 < _tolerance(z))
        pixels = cv2.distanceTransform(np.pad(smooth.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        rows, columns = self._sample_pixels()
        seen = z[rows, columns]
        return (pixels[rows, columns] * seen / self.intrinsic[:2].max())[seen > 0]

    def horizontal_points(self) -> Array:
        """Return the points (N, 3) of horizontal surfaces in the world frame, m."""
        grid, known = self._compute_grid()
        across, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
        normals = np.cross(across, down)
        level = np.abs(normals[..., 2]) > HORIZONTAL * np.linalg.norm(normals, axis=-1)
        joined = np.maximum(np.linalg.norm(across, axis=-1), np.linalg.norm(down, axis=-1)) < JUMP
        return grid[:-1, :-1][level & joined & known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:]]

    def _compute_grid(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return points (R, C, 3) of sampled pixels in the world, m, and a mask (R, C) of known depth."""
        rows, columns = self._sample_pixels()
        z = self.depth[rows, columns].astype(np.float64) / 1000
        fx, fy, cx, cy = self.intrinsic
        # SAPIEN's rays go through pixel centres, at + 0.5.
        local = np.stack([(columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z], axis=-1)
        return local @ self.camera_in_world[:3, :3].T + self.camera_in_world[:3, 3], z > 0

    def _sample_pixels(self) -> NDArray[np.int64]:
        step = max(1, self.depth.shape[0] // POINT_ROWS)
        return np.mgrid[step // 2 : self.depth.shape[0] : step, step // 2 : self.depth.shape[1] : step]


def check_depth_views(steps: Sequence[Sequence[DepthView]]) -> Iterator[tuple[int, str, str, str]]:
    """Yield (index into ``steps``, camera, expected, found) per violation.

    Each rule yields at most one violation per camera. ``steps`` has the depth images of all cameras, for each checked
    step.
    """
    reported: set[tuple[str, str]] = set()
    agreement: dict[str, float] = {}  # camera -> highest fraction of agreeing points
    for index, views in enumerate(steps):
        clouds = {view.camera: view.points() for view in views}
        edge_distances_of = {view.camera: view.edge_distances() for view in views}
        violations = [violation for view in views for violation in _check_floor(view, clouds[view.camera])]
        seen = {camera for camera, points in clouds.items() if len(points) >= MIN_POINTS}
        for camera in clouds:
            if seen - {camera}:
                agreement.setdefault(camera, 0.0)
        for view in views:
            for other in views:
                if other is view:
                    continue
                count, through, agree = compare_depth(clouds[other.camera], view, edge_distances_of[other.camera])
                if count < MIN_POINTS:
                    continue
                for camera in (view.camera, other.camera):
                    agreement[camera] = max(agreement.get(camera, 0.0), agree)
                if through > SEEN_THROUGH:
                    found = f"{through:.0%} of {count} points seen through"
                    violations.append((view.camera, f"no view through surfaces that {other.camera} sees", found))
        for camera, expected, found in violations:
            if (camera, expected) not in reported:
                reported.add((camera, expected))
                yield index, camera, expected, found
    for camera, fraction in agreement.items():
        if fraction < AGREEING:
            yield 0, camera, "depth that agrees with another camera", f"at most {fraction:.0%} of the points agree"


def _check_floor(view: DepthView, points: Array) -> Iterator[tuple[str, str, str]]:
    if len(points) < MIN_POINTS:
        return
    heights = points[:, 2]
    below = np.mean(heights < -FLOOR_TOLERANCE)
    if below > 0.01:
        yield view.camera, "no points below the floor", f"{below:.0%} of the points, down to {heights.min():.2f} m"
    if view.on_gripper:
        return
    level = np.abs(view.horizontal_points()[:, 2])
    near = level[level < FLOOR_BAND]
    if len(near) > MIN_POINTS and np.median(near) > FLOOR_TOLERANCE:
        yield view.camera, "the floor at height 0", f"the floor {np.median(near) * 100:.0f} cm off"


def compare_depth(points: Array, view: DepthView, edge_distances: Array) -> tuple[int, float, float]:
    """Compare the points that one camera sees with the depth image of another camera.

    ``points`` (N, 3) are in the world frame, m. ``edge_distances`` (N,) in m: see `DepthView.edge_distances`. Return
    the number of points inside the image, the fraction of them that the other camera sees through (it measures a larger
    depth), and the fraction whose depth it confirms.
    """
    local = (points - view.camera_in_world[:3, 3]) @ inverse(view.camera_in_world)[:3, :3].T
    local, edge_distances = local[local[:, 2] > NEAR], edge_distances[local[:, 2] > NEAR]
    fx, fy, cx, cy = view.intrinsic
    z = local[:, 2]
    columns = np.floor(local[:, 0] / z * fx + cx).astype(int)
    rows = np.floor(local[:, 1] / z * fy + cy).astype(int)
    height, width = view.depth.shape
    inside = (columns >= 1) & (columns < width - 1) & (rows >= 1) & (rows < height - 1)
    rows, columns, z, edge_distances = rows[inside], columns[inside], z[inside], edge_distances[inside]
    if len(z) == 0:
        return 0, 0.0, 0.0
    around = np.stack([view.depth[rows + i, columns + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]) / 1000
    known = np.all(around > 0, axis=0)
    if not known.any():
        return 0, 0.0, 0.0
    z, nearest, farthest = z[known], around[:, known].min(axis=0), around[:, known].max(axis=0)
    tolerance = _tolerance(z)
    through = nearest > z + tolerance
    significant = edge_distances[known] > z / view.intrinsic[:2].min()
    agree = ~through & (farthest > z - tolerance)
    seen_through = float(np.mean(through[significant])) if np.sum(significant) >= MIN_POINTS else 0.0
    return len(z), seen_through, float(np.mean(agree))


def _tolerance(z: Array) -> Array:
    return 0.01 + 0.01 * z
