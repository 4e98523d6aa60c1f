"""Correction of camera poses: the robot in an image must fit the known surface of the robot.

The pose of a camera is estimated by point-to-plane ICP (iterative closest points; Chen and Medioni, 1992) between the
points of a depth image and the surface of the robot at its measured joint positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.observed_scene import sample_pixels, unproject
from robocas_ms3.baselines.keyframe.perception import CameraFrame
from robocas_ms3.core.poses import Array, inverse, transform_points

_PIXELS = 4  # between points
_NEAR_ROBOT = 0.25  # m from the nominal surface of the robot, within which points may belong to it
_MAX_POINTS, _MIN_POINTS = 1500, 100
_RADII = (0.1, 0.06, 0.04, 0.025, 0.015, 0.01, 0.006)  # m between matched points, from the first to the last round
_ITERATIONS, _CONVERGED = 6, 1e-4  # per round; rad and m
_MATCH, _MIN_MATCHES = 0.003, 60  # m from the surface; least number of points that match it
_MATCH_FACTOR = 1.5  # matches with the correction, as a factor of those without it
_STARTS, _START_ROTATION, _START_SHIFT = 16, np.deg2rad(12), 0.06  # initial poses; along and about each axis, rad and m
_MAX_ROTATION, _MAX_SHIFT = np.deg2rad(25), 0.2  # rad and m, greatest plausible errors of a camera pose
_MIN_ROTATION, _MIN_SHIFT = np.deg2rad(1.0), 0.008  # rad and m, smaller errors are not corrected


def estimate_corrections(frames: Mapping[str, CameraFrame], points: Array, normals: Array) -> dict[str, Array]:
    """Return by camera the result of `estimate_correction`, without the cameras whose error is unknown."""
    found = {camera: estimate_correction(frame, points, normals) for camera, frame in frames.items()}
    return {camera: correction for camera, correction in found.items() if correction is not None}


def correct_frames(
    frames: dict[str, CameraFrame], corrections: Mapping[str, Array], hand_camera: str
) -> dict[str, CameraFrame]:
    """Return images with corrected camera poses; the same images if no camera has an error.

    If one camera has an error, images of fixed cameras whose error is unknown are left out.

    Args:
        frames: by camera, the image with the nominal pose of the camera.
        corrections: result of `estimate_corrections` for the first images of the episode.
        hand_camera: name of the camera on the hand.
    """
    identity = np.eye(4)
    if all((correction == identity).all() for correction in corrections.values()):
        return frames
    return {
        camera: replace(frame, camera_in_base=frame.camera_in_base @ corrections.get(camera, identity))
        for camera, frame in frames.items()
        if camera in corrections or camera == hand_camera
    }


def estimate_correction(frame: CameraFrame, points: Array, normals: Array) -> Array | None:
    """Estimate the error of a camera pose from an image of the robot.

    Args:
        frame: image with the nominal pose of the camera.
        points, normals: (P, 3) surface of the robot in the arm's base frame (`RobotSurface.compute_points`).

    Returns:
        Pose (4, 4) of the camera in the frame of its nominal pose; the identity if the nominal pose fits. None if
        the image does not show enough of the robot, or no pose fits.
    """
    pose = frame.camera_in_base.astype(np.float64)
    pixels = sample_pixels(frame.depth.shape, _PIXELS, _PIXELS // 2)
    observed, valid = unproject(frame.depth, frame.intrinsics, pose, pixels)
    if not len(points):
        return None
    distance, _ = KDTree(points).query(observed[valid], distance_upper_bound=_NEAR_ROBOT)
    observed = observed[valid][np.isfinite(distance)]
    if len(observed) < _MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    if len(observed) > _MAX_POINTS:
        observed = rng.choice(observed, _MAX_POINTS, replace=False)
    alignment = _Alignment(observed, pose[:3, 3], points, normals)
    first = alignment.refine(np.eye(4))
    if not _is_large(first, pose):
        return np.eye(4) if alignment.count_matches(first) >= _MIN_MATCHES else None
    least = max(_MIN_MATCHES, _MATCH_FACTOR * alignment.count_matches(np.eye(4)))
    found = [first, *(alignment.refine(start) for start in _draw_starts(pose, rng))]
    matches = [alignment.count_matches(motion) if _is_plausible(motion, pose) else 0 for motion in found]
    best = found[int(np.argmax(matches))]
    return inverse(pose) @ best @ pose if max(matches) >= least else None


class _Alignment:
    """Alignment of observed points (N, 3) with a surface; motions (4, 4) move the observed points and their camera."""

    def __init__(self, observed: Array, camera: Array, points: Array, normals: Array) -> None:
        self._observed, self._camera, self._points, self._normals = observed, camera, points, normals

    def refine(self, motion: Array) -> Array:
        """Return the motion to which ICP converges from an initial motion."""
        for radius in _RADII:
            surface, normals, tree = self._select_visible(motion)
            for _ in range(_ITERATIONS):
                moved = transform_points(motion, self._observed)
                near, index = _match(tree, moved, radius)
                if len(index) < _MIN_MATCHES:
                    return motion
                step, size = _solve_step(moved[near], surface[index], normals[index], 0.3 * radius)
                motion = step @ motion
                if size < _CONVERGED:
                    break
        return motion

    def count_matches(self, motion: Array) -> int:
        """Return the number of observed points on the visible surface."""
        surface, normals, tree = self._select_visible(motion)
        moved = transform_points(motion, self._observed)
        near, index = _match(tree, moved, _RADII[-1])
        offsets = np.einsum("ij,ij->i", normals[index], surface[index] - moved[near])
        return int((np.abs(offsets) < _MATCH).sum())

    def _select_visible(self, motion: Array) -> tuple[Array, Array, KDTree]:
        """Return the points whose normals point to the camera, with their normals."""
        to_camera = transform_points(motion, self._camera[None])[0] - self._points
        visible = np.einsum("ij,ij->i", self._normals, to_camera) > 0
        return self._points[visible], self._normals[visible], KDTree(self._points[visible])


def _match(tree: KDTree, moved: Array, radius: float) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which points have a neighbour within a radius, and the indices of these neighbours."""
    distance, index = tree.query(moved, distance_upper_bound=radius)
    near = np.isfinite(distance)
    return near, np.asarray(index)[near]


def _solve_step(moved: Array, surface: Array, normals: Array, scale: float) -> tuple[Array, float]:
    """Return the motion that reduces the distances of points to planes, and its largest component in rad or m.

    scale: distance in m at which the weight of a point is one half (Cauchy weights).
    """
    offsets = np.einsum("ij,ij->i", normals, surface - moved)
    center = moved.mean(axis=0)
    jacobian = np.concatenate([np.cross(moved - center, normals), normals], axis=1)
    weighted = jacobian * (1 / (1 + (offsets / scale) ** 2))[:, None]
    step = np.linalg.solve(jacobian.T @ weighted + 1e-6 * len(moved) * np.eye(6), weighted.T @ offsets)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    motion[:3, 3] = step[3:] + center - motion[:3, :3] @ center
    return motion, float(np.abs(step).max())


def _draw_starts(pose: Array, rng: np.random.Generator) -> Iterator[Array]:
    for _ in range(_STARTS):
        start = np.eye(4)
        rotation = Rotation.from_rotvec(rng.uniform(-_START_ROTATION, _START_ROTATION, 3))
        start[:3, :3] = rotation.as_matrix()
        start[:3, 3] = rng.uniform(-_START_SHIFT, _START_SHIFT, 3)
        yield pose @ start @ inverse(pose)


def _measure(motion: Array, pose: Array) -> tuple[float, float]:
    """Return rotation in rad and shift in m of a camera by a motion."""
    change = inverse(pose) @ motion @ pose
    return float(Rotation.from_matrix(change[:3, :3]).magnitude()), float(np.linalg.norm(change[:3, 3]))


def _is_plausible(motion: Array, pose: Array) -> bool:
    rotation, shift = _measure(motion, pose)
    return rotation < _MAX_ROTATION and shift < _MAX_SHIFT


def _is_large(motion: Array, pose: Array) -> bool:
    rotation, shift = _measure(motion, pose)
    return rotation > _MIN_ROTATION or shift > _MIN_SHIFT
