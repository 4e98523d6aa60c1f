"""The plots that trajectories and RoboCAS folders share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.viewer.parts import plot

XYZ = ("x", "y", "z")
ROLL_PITCH_YAW = ("roll", "pitch", "yaw")
ARM = tuple(f"j{i}" for i in range(1, 8))


def motion_plots(position: NDArray, xyzw: NDArray, arm_joints: NDArray) -> list[dict[str, Any]]:
    """TCP and joints.

    Args:
        position: (T, 3) m, TCP in the arm's base.
        xyzw: (T, 4) its orientation there.
        arm_joints: (T, 7) rad.
    """
    if len(xyzw) and xyzw[0][np.abs(xyzw[0]).argmax()] < 0:
        xyzw = -xyzw
    flips = (
        np.cumsum(np.sum(xyzw[1:] * xyzw[:-1], axis=1) < 0) % 2
    )  # q and -q are one orientation: no jumps, one choice
    xyzw = np.concatenate([xyzw[:1], xyzw[1:] * np.where(flips, -1, 1)[:, None]])
    return [
        plot("TCP position, arm base", "m", XYZ, position),
        plot("TCP orientation, arm base", "quaternion", ("x", "y", "z", "w"), xyzw),
        plot("Arm joints", "rad", ARM, arm_joints),
    ]


def gripper_plot(width: NDArray, is_open: NDArray | None, open_width: float = 0.08) -> dict[str, Any]:
    """Width in mm, and the command as the width that it asks for."""
    if is_open is None:
        return plot("Gripper", "mm", ("width",), np.ravel(width)[:, None] * 1000)
    command = np.where(is_open, open_width, 0.0)
    return plot("Gripper", "mm", ("width", "command"), np.column_stack([width, command]) * 1000)


def base_plot(pose: NDArray) -> list[dict[str, Any]]:
    """Mobile base (T, 3) x, y in m, yaw in rad; none where it stands still."""
    pose = np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])])
    moves = len(pose) > 0 and np.ptp(pose, axis=0).max() > 1e-3
    return [plot("Mobile base, world", "m, rad", ("x", "y", "yaw"), pose)] if moves else []
