"""Which annotated grasps an arm should try, and in what order: geometry only, no simulator."""

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
    check_directions,
    to_tcp_frames,
)

Array = NDArray[np.float64]

# What lies between the pads, in the TCP's frame, and how a robot may miss: across the pads, and not deep enough, m
PAD_HALF_WIDTH, PAD_BEHIND_TCP, PAD_BEFORE_TCP = 0.009, -0.012, 0.008
GRIP_SHIFTS = ((0.0, 0.0), (0.006, 0.0), (-0.006, 0.0), (0.0, -0.006), (0.004, -0.004), (-0.004, -0.004))
PAD_POINTS = 10  # of a surface at 5 mm: a third of what fits
FINGER_CLEARANCE = 0.006  # m between an object and each open finger
MARGIN_WEIGHT = 1.0
TURN_WEIGHT = 0.4  # per rad
TEMPERATURE = 0.15


@dataclass(frozen=True)
class Grasps:
    """Grasps that a robot could try; the second half are the first half with the wrist turned by 180 deg.

    Attributes:
        widths: (2K,) opening the object needs there, m.
        index: (2K,) of each one among the annotated grasps.
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
    """Return the annotated grasps that a robot standing there could try, from above or from the front."""
    poses = object_in_world @ annotations.grasps_tcp_in_object
    base_to_object = object_in_world[:3, 3] - arm_base_in_world[:3, 3]
    passed = annotations.grasp_widths <= MAX_WIDTH
    for test in check_directions(poses, base_to_object, approach).values():
        passed = passed & test
    index = np.flatnonzero(passed)
    both = np.concatenate([index, index])
    tcp = np.concatenate([poses[index], poses[index] @ HALF_TURN])
    qualities = 1.1 - annotations.grasp_qualities[both]  # the scale of RoboCAS-v0
    return Grasps(tcp, annotations.grasp_widths[both], qualities, both)


def grip_margins(tcp: Array, widths: Array, surface: Array) -> Array:
    """Return how much (N,) of an object is between the pads even where a grasp misses a little, 0 to 1.

    1: at least ``PAD_POINTS`` lie between the pads of each of several shifted grasps, and ``FINGER_CLEARANCE`` is left
    beside the object while the gripper is open.

    Args:
        tcp: (N, 4, 4) grasps, in the frame of ``surface`` (P, 3), points of the object 5 mm apart, m.
        widths: (N,) of the object there, m.
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
    """Return a score (N,) of each grasp, more is better.

    The score adds quality (relative to the best), nearness of the TCP to the object's centre (falls by e every 3 cm),
    steepness (1 straight down, 0 level; from the front the other way round), nearness in joint space, and the margin.

    Args:
        tcp: (N, 4, 4) in any upright frame, which ``object_center`` (3,) is in too.
        qualities, margins: (N,), more is better.
        turns: (N,) rad, of the joint that turns most on the way there, which sets the time.
    """
    quality = qualities / max(float(np.abs(qualities).max()), 1e-9)
    distance = np.linalg.norm(tcp[:, :3, 3] - object_center, axis=1)
    steep = -tcp[:, 2, 2] if approach == "top" else np.linalg.norm(tcp[:, :2, 2], axis=1)
    score = quality + np.exp(-distance / 0.03) + 0.7 * steep - TURN_WEIGHT * turns
    return score + MARGIN_WEIGHT * margins


def sample_order(rng: np.random.Generator, scores: Array) -> NDArray[np.int_]:
    """Order grasps by score (N,), with some chance: one overtakes one that is 0.15 better about one time in four."""
    # Gumbel noise turns scores into draws without replacement, weighted by exp(score / TEMPERATURE).
    return np.argsort(-(scores + TEMPERATURE * rng.gumbel(size=len(scores))), kind="stable")
