"""Errors between poses."""

from __future__ import annotations

import numpy as np
import pytest

from robocas_ms3.planning.kinematics import pose_error


@pytest.mark.parametrize(("turn", "expected"), [(0.0, 0.0), (1e-5, 1e-5), (0.7, 0.7), (2.5, 2.5), (np.pi, np.pi)])
def test_pose_error_by_hand(turn, expected):
    from scipy.spatial.transform import Rotation

    a, b = np.eye(4), np.eye(4)
    b[:3, :3], b[:3, 3] = Rotation.from_rotvec([0, turn, 0]).as_matrix(), (0.3, 0, 0.4)
    assert pose_error(a, b) == pytest.approx((0.5, expected), abs=1e-7)
