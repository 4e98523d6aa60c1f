"""Chunks of future TCP poses, relative to the present one.

A row of a chunk is (10,): position in m and the first two columns of the rotation matrix (Zhou et al. 2019), both in
the present frame of the TCP; and the gripper command, 1 = open. Unlike chained motions, poses do not depend on how far
the TCP came with the last action, so errors of the controller are corrected.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.poses import Array, from_parts, inverse

ROW = 10
_MIN_DEVIATION = np.array([0.004] * 3 + [0.02] * 6)  # m and 1: smaller deviations are noise


def state_of(poses: NDArray[np.floating], widths: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return proprioception (N, 10) of TCP poses (N, 4, 4) in the arm's base and gripper widths (N,) in m."""
    turns = poses[:, :3, :2].swapaxes(1, 2).reshape(len(poses), 6)
    return np.concatenate([poses[:, :3, 3], turns, widths[:, None] / 0.08], axis=1).astype(np.float32)


def encode(poses: Array, opened: NDArray[Any], steps: int) -> NDArray[np.float32]:
    """Return the chunks of an episode.

    Args:
        poses: (T, 4, 4) of the TCP in the arm's base.
        opened: (T,) gripper commands, as ``gripper_status``: that of row t led to step t.
        steps: K.

    Returns:
        (T, K, 10); rows after the end repeat the last pose and command.
    """
    length = len(poses)
    ahead = np.minimum(np.arange(length)[:, None] + np.arange(1, steps + 1), length - 1)  # (T, K)
    return _rows(inverse(poses)[:, None] @ poses[ahead], np.asarray(opened, np.float64)[ahead])


def next_keys(poses: Array, opened: NDArray[Any]) -> NDArray[np.float32]:
    """Return the TCP poses (T, 9) at the next change of the gripper command, or at the end; rows as above."""
    length = len(poses)
    changes = np.flatnonzero(np.diff(np.asarray(opened, np.int8))).tolist()  # the last steps before a change
    places = np.array([next((change for change in changes if change >= t), length - 1) for t in range(length)])
    return _rows(inverse(poses) @ poses[places], np.zeros(length))[:, :9]


def decode(rows: NDArray[np.floating], tcp: NDArray[np.floating]) -> tuple[Array, NDArray[np.float64]]:
    """Return the poses of chunks in the arm's base, and gripper commands.

    Args:
        rows: (..., 10).
        tcp: (4, 4) or (..., 4, 4) present pose of the TCP in the arm's base.

    Returns:
        (..., 4, 4) and (...,) commands, 1 = open, as predicted.
    """
    rows = np.asarray(rows, np.float64)
    first = rows[..., 3:6] / np.maximum(np.linalg.norm(rows[..., 3:6], axis=-1, keepdims=True), 1e-9)
    second = rows[..., 6:9] - (first * rows[..., 6:9]).sum(-1, keepdims=True) * first
    second /= np.maximum(np.linalg.norm(second, axis=-1, keepdims=True), 1e-9)
    turns = np.stack([first, second, np.cross(first, second)], axis=-1)
    return tcp @ from_parts(rows[..., :3], turns), rows[..., 9]


def _rows(poses: Array, opened: NDArray[np.floating]) -> NDArray[np.float32]:
    turns = poses[..., :3, :2].swapaxes(-1, -2).reshape(*poses.shape[:-2], 6)
    return np.concatenate([poses[..., :3, 3], turns, opened[..., None]], axis=-1).astype(np.float32)


class Scale(torch.nn.Module):
    """Normalises numbers to mean 0 and deviation 1, and back; saved with the weights, not trained.

    Args:
        mean, deviation: lists of numbers, of any nesting.
    """

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(self, mean: Any, deviation: Any) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32))
        self.register_buffer("deviation", torch.tensor(deviation, dtype=torch.float32))

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Return normalised values."""
        return (values - self.mean) / self.deviation

    def back(self, values: torch.Tensor) -> torch.Tensor:
        """Return values that are not normalised any more."""
        return values * self.deviation + self.mean


def spread(motions: NDArray[np.floating]) -> dict[str, Any]:
    """Return the arguments of a `Scale` of poses (..., N, 9), per row of the chunk."""
    return {"mean": motions.mean(0).tolist(), "deviation": np.maximum(motions.std(0), _MIN_DEVIATION).tolist()}
