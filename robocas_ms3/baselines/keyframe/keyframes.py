"""Keyframe that was chosen: the grasp of an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robocas_ms3.baselines.keyframe.motion import Approach
from robocas_ms3.baselines.keyframe.observed_scene import ObservedObject, ObservedScene
from robocas_ms3.core.poses import Array

_SAFE_HEIGHT = (0.35, 0.55)  # m, least and greatest height of the TCP for motions above objects
_CLEARANCE = 0.12  # m between the TCP and the highest object near a grasp
_HANGING = (0.015, 0.3)  # m from the TCP down to the lowest point of a held object, least and greatest value


@dataclass(frozen=True)
class Keyframe:
    """Grasp that was chosen: the object, its scene, the approach, and from the front the path (n, 7) to its start."""

    scene: ObservedScene
    object: ObservedObject
    approach: Approach
    path: Array | None = None

    @property
    def hanging(self) -> float:
        """Distance in m from the TCP down to the lowest point of the object.

        The lowest point may be hidden. Therefore the object is assumed to reach as far below its predicted centre as
        above it.
        """
        heights = self.scene.points[self.object.mask][:, 2]
        low = min(heights.min(), 2 * self.object.center[2] - heights.max())
        return float(np.clip(self.approach.grasp[2, 3] - low, *_HANGING))

    @property
    def safe_height(self) -> float:
        """Height of the TCP in m at which it passes over all objects near the grasp."""
        points = self.scene.points
        near = points[np.linalg.norm(points[:, :2] - self.approach.grasp[:2, 3], axis=1) < 0.35]
        return float(np.clip(near[:, 2].max() + _CLEARANCE, *_SAFE_HEIGHT))
