"""Filter, score and order the annotated grasps of an object. Geometry only, no simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.annotations import Annotations
from robocas_ms3.scenes.grasp_checks import (
    HALF_TURN,
    MAX_WIDTH,
    TESTED_AT_ONCE,
    Approach,
    grasp_direction_tests,
    to_tcp_frames,
)

Array = NDArray[np.float64]

# Volume between the pads in the TCP frame, and offsets of an imprecise grasp: across the pads, along the approach (m)
PAD_HALF_WIDTH, PAD_BEHIND_TCP, PAD_BEFORE_TCP = 0.009, -0.012, 0.008
GRIP_SHIFTS = ((0.0, 0.0), (0.006, 0.0), (-0.006, 0.0), (0.0, -0.006), (0.004, -0.004), (-0.004, -0.004))
PAD_POINTS = 10  # surface points (5 mm apart) between the pads of a firm grasp; about 30 fit
FINGER_CLEARANCE = 0.006  # m between the object and each open finger
MARGIN_WEIGHT = 1.0
TURN_WEIGHT = 0.4  # per rad
TEMPERATURE = 0.15


@dataclass(frozen=True)
class Grasps:
    """Candidate grasps of an object.

    The first K rows are annotated grasps; the other K rows are the same grasps with the wrist turned by 180 deg.

    Attributes:
        tcp_in_world: (2K, 4, 4) TCP poses.
        widths: (2K,) distance between the finger pads when they touch the object, m.
        qualities: (2K,) annotated qualities, greater is better.
        index: (2K,) indices of the grasps in the annotations.
    """

    tcp_in_world: Array
    widths: Array
    qualities: Array
    index: NDArray[np.int_]

    def __len__(self) -> int:
        return len(self.index)


def filter_grasps(
    annotations: Annotations, object_in_world: Array, arm_base_in_world: Array, approach: Approach = "top"
) -> Grasps:
    """Return the annotated grasps that are narrow enough and have a suitable direction.

    Args:
        annotations: annotations of the object.
        object_in_world: (4x4) pose of the object.
        arm_base_in_world: (4x4) pose of the arm's base.
        approach: direction of the approach, from above (``top``) or from the front (``front``).
    """
    poses = object_in_world @ annotations.grasps_tcp_in_object
    base_to_object = object_in_world[:3, 3] - arm_base_in_world[:3, 3]
    passed = annotations.grasp_widths <= MAX_WIDTH
    for test in grasp_direction_tests(poses, base_to_object, approach).values():
        passed = passed & test
    index = np.flatnonzero(passed)
    both = np.concatenate([index, index])
    tcp = np.concatenate([poses[index], poses[index] @ HALF_TURN])
    qualities = 1.1 - annotations.grasp_qualities[both]  # the scale of RoboCAS-v0
    return Grasps(tcp, annotations.grasp_widths[both], qualities, both)


def compute_grip_margins(tcp: Array, widths: Array, surface: Array) -> Array:
    """Return the robustness (N,) of grasps against position errors, 0 to 1.

    The value is 1 if at least ``PAD_POINTS`` surface points are between the pads for each offset in
    ``GRIP_SHIFTS``, and each open finger has at least ``FINGER_CLEARANCE`` to the object.

    Args:
        tcp: (N, 4, 4) TCP poses in the frame of ``surface``.
        widths: (N,) widths of the object at the grasps, m.
        surface: (P, 3) surface points of the object, 5 mm apart, m.
    """
    margin = np.clip((MAX_WIDTH - np.asarray(widths)) / 2 / FINGER_CLEARANCE, 0, 1)
    widest, deepest = np.abs(GRIP_SHIFTS).max(axis=0)
    batch = max(1, TESTED_AT_ONCE // len(surface))
    for start in range(0, len(tcp), batch):
        x, y, z = to_tcp_frames(tcp[start : start + batch], surface)
        near = (np.abs(y) <= MAX_WIDTH / 2) & (np.abs(x) <= PAD_HALF_WIDTH + widest)
        near &= (z >= PAD_BEHIND_TCP - deepest) & (z <= PAD_BEFORE_TCP + deepest)
        grasp, _ = np.nonzero(near)
        x, z = x[near], z[near]
        some = margin[start : start + batch]
        for across, deeper in GRIP_SHIFTS:
            inside = np.abs(x - across) <= PAD_HALF_WIDTH
            inside &= (z >= PAD_BEHIND_TCP + deeper) & (z <= PAD_BEFORE_TCP + deeper)
            np.minimum(some, np.bincount(grasp[inside], minlength=len(some)) / PAD_POINTS, out=some)
    return margin


def score_grasps(
    tcp: Array, qualities: Array, margins: Array, turns: Array, object_center: Array, approach: Approach = "top"
) -> Array:
    """Return scores (N,) of grasps; greater is better.

    The score is a weighted sum of five terms: the quality relative to the best quality; the proximity of the TCP to the
    object's centre, which falls by a factor e per 3 cm; the steepness (approach from above: 1 straight down, 0
    horizontal; from the front: 0 straight down, 1 horizontal); minus the joint displacement; and the margin.

    Args:
        tcp: (N, 4, 4) TCP poses in any frame with a vertical z axis.
        qualities: (N,) annotated qualities.
        margins: (N,) result of `compute_grip_margins`.
        turns: (N,) largest joint displacement on the way to the grasp, rad, which determines the duration.
        object_center: (3,) centre of the object in the frame of ``tcp``.
        approach: direction of the approach.
    """
    quality = qualities / max(float(np.abs(qualities).max()), 1e-9)
    distance = np.linalg.norm(tcp[:, :3, 3] - object_center, axis=1)
    steep = -tcp[:, 2, 2] if approach == "top" else np.linalg.norm(tcp[:, :2, 2], axis=1)
    score = quality + np.exp(-distance / 0.03) + 0.7 * steep - TURN_WEIGHT * turns
    return score + MARGIN_WEIGHT * margins


def sample_grasp_order(rng: np.random.Generator, scores: Array) -> NDArray[np.int_]:
    """Sample an order (N,) of grasp indices in which grasps with greater scores (N,) tend to come first.

    If the score of a grasp is 0.15 below that of another grasp, it comes before the other with probability 0.27.
    """
    # Gumbel noise gives draws without replacement, weighted by exp(score / TEMPERATURE)
    return np.argsort(-(scores + TEMPERATURE * rng.gumbel(size=len(scores))), kind="stable")
