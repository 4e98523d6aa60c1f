"""Grasp that the policy chose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robocas_ms3.baselines.keyframe.motion import Approach
from robocas_ms3.baselines.keyframe.observed_scene import ObservedObject, ObservedScene
from robocas_ms3.core.poses import Array

_SAFE_HEIGHT = (0.35, 0.55)  # m, least and greatest height of the TCP for motions above objects
_CLEARANCE = 0.12  # m between the TCP and the highest object near a grasp
_DEPTH_BELOW_TCP = (0.015, 0.3)  # m from the TCP down to the lowest point of a held object, least and greatest value


@dataclass(frozen=True)
class ChosenGrasp:
    """Grasp that the policy chose.

    Attributes:
        scene: observed scene.
        object: object that is grasped.
        approach: motion to the grasp.
        path: joint positions (n, 7) on the way to the start of the approach, for grasps from the front; else None.
    """

    scene: ObservedScene
    object: ObservedObject
    approach: Approach
    path: Array | None = None

    @property
    def depth_below_tcp(self) -> float:
        """Distance in m from the TCP down to the lowest point of the object.

        The lowest point may be hidden. Therefore the object is assumed to reach as far below its predicted centre as
        above it.
        """
        heights = self.scene.points[self.object.mask][:, 2]
        low = min(heights.min(), 2 * self.object.center[2] - heights.max())
        return float(np.clip(self.approach.grasp[2, 3] - low, *_DEPTH_BELOW_TCP))

    @property
    def safe_height(self) -> float:
        """Height of the TCP in m at which it passes over all objects near the grasp."""
        points = self.scene.points
        near = points[np.linalg.norm(points[:, :2] - self.approach.grasp[:2, 3], axis=1) < 0.35]
        return float(np.clip(near[:, 2].max() + _CLEARANCE, *_SAFE_HEIGHT))
