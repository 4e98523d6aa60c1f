"""What policies with chunks predict: where the TCP will be, step after step, seen from where it is.

A row of a chunk is (10,): position m, the first two columns of the rotation matrix (Zhou et al. 2019), both in the
TCP's frame now; and the gripper's command, 1 = open. Poses do not depend on how far the TCP came with the last action,
as chained motions would: what went wrong is made up for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.poses import Array, from_parts, inverse

ROW = 10
_FLOOR = np.array([0.004] * 3 + [0.02] * 6)  # m and 1: deviations below that are noise to be left as it is


def state_of(poses: NDArray[np.floating], widths: NDArray[np.floating]) -> NDArray[np.float32]:
    """(N, 10) of poses (N, 4, 4) of the TCP in the arm's base and gripper widths (N,), in m: what the arm feels."""
    turns = poses[:, :3, :2].swapaxes(1, 2).reshape(len(poses), 6)
    return np.concatenate([poses[:, :3, 3], turns, widths[:, None] / 0.08], axis=1).astype(np.float32)


def encode(poses: Array, opened: NDArray[Any], steps: int) -> NDArray[np.float32]:
    """Chunks of an episode.

    Args:
        poses: (T, 4, 4) of the TCP in the arm's base.
        opened: (T,) commands in force, as ``gripper_status``: that of row t led to step t.
        steps: K.

    Returns:
        (T, K, 10); beyond the end the TCP stays, and so does the command.
    """
    length = len(poses)
    ahead = np.minimum(np.arange(length)[:, None] + np.arange(1, steps + 1), length - 1)  # (T, K)
    return _rows(inverse(poses)[:, None] @ poses[ahead], np.asarray(opened, np.float64)[ahead])


def next_keys(poses: Array, opened: NDArray[Any]) -> NDArray[np.float32]:
    """(T, 9) where the TCP will be when the gripper's command changes next, or at the end; rows as above."""
    length = len(poses)
    changes = np.flatnonzero(np.diff(np.asarray(opened, np.int8))).tolist()  # the last steps before a change
    places = np.array([next((change for change in changes if change >= t), length - 1) for t in range(length)])
    return _rows(inverse(poses) @ poses[places], np.zeros(length))[:, :9]


def decode(rows: NDArray[np.floating], tcp: NDArray[np.floating]) -> tuple[Array, NDArray[np.float64]]:
    """Poses of chunks in the arm's base, and commands.

    Args:
        rows: (..., 10).
        tcp: (4, 4) or (..., 4, 4) where the TCP is, in the arm's base.

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
    """Takes numbers to mean 0 and deviation 1, and back; not trained, but kept with the weights.

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
        """Normalised."""
        return (values - self.mean) / self.deviation

    def back(self, values: torch.Tensor) -> torch.Tensor:
        """As they were."""
        return values * self.deviation + self.mean


def spread(motions: NDArray[np.floating]) -> dict[str, Any]:
    """Arguments of a `Scale` of motions (..., N, 9), by place in the chunk."""
    return {"mean": motions.mean(0).tolist(), "deviation": np.maximum(motions.std(0), _FLOOR).tolist()}
