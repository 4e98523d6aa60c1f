"""7-D actions of RoboCAS: computed from the arrays of an episode, normalized, and converted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets.sources.files import SEE_VALIDATE
from robocas_ms3.demos.recordings.motion import to_dataset_actions

ACTION_NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
"""Translation in m and Euler xyz angles in rad, both in the EEF frame at the step; gripper command, 1 = open."""
ACTION_ARRAYS = ("rel_pos", "rel_orn", "gripper_status")
"""Keys of ``episode_info.npz`` from which actions are computed."""
_RANGES = "relative_position and relative_rotation, each [lowest (3), highest (3)]"


def compute_actions(arrays: Mapping[str, NDArray]) -> NDArray[np.float32]:
    """Compute the 7-D actions (T, 7) of an episode from its arrays.

    Row t moves the robot from step t to step t + 1; the last row has no motion. Columns: translation ``rel_pos[t]`` in
    m; rotation ``rel_orn[t]`` as Euler angles in rad about the fixed axes x, y, z (scipy's "xyz", as in
    ``action_space``); gripper command ``gripper_status[t + 1]``, 1 = open (the last row repeats the command).
    """
    return to_dataset_actions(arrays["rel_pos"], arrays["rel_orn"], arrays["gripper_status"])


def compute_valid_actions(arrays: Mapping[str, NDArray], where: str) -> NDArray[np.float32]:
    """Compute the 7-D actions (T, 7) of an episode; raise DatasetError if its arrays are damaged.

    ``where`` names the episode in the error.
    """
    check_finite(arrays, where)
    try:
        return compute_actions(arrays)
    except ValueError as error:
        what, found = "no actions can be computed from these arrays", one_line(error)
        raise DatasetError(what, where=where, found=found, fix=SEE_VALIDATE) from error


def to_joint_positions(actions: NDArray) -> NDArray[np.float32]:
    """Convert ``action.joint`` of a dataset (..., 8) to actions of the convention ``joint_positions``.

    The seven joint targets in rad stay. The gripper is 0 (closed) to 1 (open) in datasets, and -1 (closed) to 1 (open)
    in ``joint_positions``.
    """
    return np.concatenate([actions[..., :7], 2 * actions[..., 7:] - 1], axis=-1).astype(np.float32)


def check_finite(arrays: Mapping[str, NDArray], where: str) -> None:
    """Raise DatasetError if an array contains NaN or infinite values; ``where`` names the episode."""
    for key, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise DatasetError("NaN or infinite value", where=f"{where}, {key}", fix=SEE_VALIDATE)


def compute_action_space(rel_pos: Sequence[NDArray], rel_orn: Sequence[NDArray]) -> dict[str, list[list[float]]]:
    """Compute ``action_space`` of ``data_info.json``.

    It has the 1st and 99th percentile of the motion per axis, in m and rad. ``rel_pos`` and ``rel_orn`` have one array
    per episode, (T, 3) and (T, 4) xyzw. Last rows are ignored, because they are 0 by definition.
    """
    positions = np.concatenate([rows[:-1] for rows in rel_pos]).astype(np.float64)
    quaternions = np.concatenate([rows[:-1] for rows in rel_orn]).astype(np.float64)
    angles = Rotation.from_quat(quaternions).as_euler("xyz")
    return {
        "relative_position": np.percentile(positions, [1, 99], axis=0).tolist(),
        "relative_rotation": np.percentile(angles, [1, 99], axis=0).tolist(),
    }


@dataclass(frozen=True)
class ActionScale:
    """Linear scale of the motion in actions.

    Attributes:
        low: (6,) motion in m and rad that becomes -1.
        high: (6,) motion in m and rad that becomes 1.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def from_action_space(cls, action_space: Mapping[str, Any], where: object = "action_space") -> ActionScale:
        """Make the scale of an ``action_space`` as in ``data_info.json``; ``where`` names it in errors."""
        try:
            rows = [np.asarray(action_space[key], float) for key in ("relative_position", "relative_rotation")]
        except (KeyError, TypeError, ValueError) as error:
            found = str(action_space)[:80]
            raise DatasetError("invalid range of actions", where=where, expected=_RANGES, found=found) from error
        if any(row.shape != (2, 3) or not np.isfinite(row).all() for row in rows):
            found = [row.tolist() for row in rows]
            raise DatasetError("invalid range of actions", where=where, expected=_RANGES, found=found)
        low, high = np.concatenate(rows, axis=1)
        return cls(low, high)

    def encode(self, actions: NDArray) -> NDArray[np.float32]:
        """Normalize actions (..., 7): motion scaled and clipped to [-1, 1], gripper unchanged.

        An axis with ``low`` = ``high`` becomes 0.
        """
        span = self.high - self.low
        scaled = 2 * (actions[..., :6] - self.low) / np.where(span > 0, span, 1) - 1
        motion = np.where(span > 0, np.clip(scaled, -1, 1), 0)
        return np.concatenate([motion, actions[..., 6:]], axis=-1).astype(np.float32)

    def decode(self, actions: NDArray) -> NDArray[np.float32]:
        """Convert normalized actions (..., 7) to m and rad: the inverse of `encode`."""
        motion = self.low + (actions[..., :6] + 1) / 2 * (self.high - self.low)
        return np.concatenate([motion, actions[..., 6:]], axis=-1).astype(np.float32)
