"""Calibration of the cameras that a policy observes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.robots.camera_models import CameraModel, find_parent_in_base, to_intrinsic_matrix
from robocas_ms3.robots.cameras import Parent


class CameraCalibration:
    """Intrinsics and poses of the cameras of a policy in N envs.

    Args:
        spec: specification of the policy.
        models: camera models by name, for each env (`SceneEnv.camera_models`).
    """

    def __init__(self, spec: PolicySpec, models: Sequence[Mapping[str, CameraModel]]) -> None:
        pose = "true_camera_in_parent" if spec.calibration == "true" else "camera_in_parent"
        self._parents: dict[str, Parent] = {name: models[0][name].parent for name in spec.cameras}
        self._intrinsics = {
            name: np.stack([to_intrinsic_matrix(of[name].intrinsic) for of in models]).astype(np.float32)
            for name in spec.cameras
        }
        self._poses = {name: np.stack([getattr(of[name], pose) for of in models]) for name in spec.cameras}

    def select_intrinsics(self, envs: NDArray[np.int64]) -> dict[str, NDArray[np.float32]]:
        """Return the intrinsic matrices (E, 3, 3) of E envs by camera."""
        return {name: of[envs] for name, of in self._intrinsics.items()}

    def compute_camera_in_base(self, envs: NDArray[np.int64], obs: Mapping[str, Any]) -> dict[str, NDArray[np.float32]]:
        """Return the poses (E, 4, 4) of the OpenCV camera frames in the arm's base frame by camera.

        Args:
            envs: (E,) indices of the envs.
            obs: last observation of the vector environment, arrays (N, ...).
        """
        tcp_in_base = from_wxyz(obs["agent"]["tcp_in_arm_base"][envs])
        tcp_in_world = from_wxyz(obs["extra"]["tcp_pose"][envs])
        arm_base_in_world = tcp_in_world @ inverse(tcp_in_base)
        return {
            name: (find_parent_in_base(parent, tcp_in_base, arm_base_in_world) @ self._poses[name][envs]).astype(
                np.float32
            )
            for name, parent in self._parents.items()
        }
