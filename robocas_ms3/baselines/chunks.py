"""Action chunks of future TCP poses: encoding, loss and policy, shared by `small` and `bc-state`.

A row of a chunk is (10,): position in m, the first two columns of the rotation matrix (Zhou et al. 2019), both in the
present TCP frame, and the gripper command (1 = open). Poses, unlike relative motions, do not depend on how far the last
action moved the TCP, so the policy corrects tracking errors of the controller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.core.poses import Array, from_rotation, from_wxyz, inverse
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.quantities import GRIPPER_WIDTH

ROW = 10
_MIN_DEVIATION = np.array([0.004] * 3 + [0.02] * 6)  # m and 1; smaller deviations are noise
_NEAR = 0.05  # m; the metric `near_mm` averages key poses closer than this
_EMPTY_WIDTH = 0.004  # m; a narrower gripper has closed on nothing

Predict = Callable[[Observations, int], NDArray[np.floating]]


def encode_proprioception(poses: NDArray[np.floating], widths: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return proprioception (N, 10): TCP poses (N, 4, 4) in the arm's base frame, gripper widths (N,) m."""
    return _rows(poses, widths / 0.08)


def encode_chunks(poses: Array, opened: NDArray[Any], steps: int) -> NDArray[np.float32]:
    """Encode the chunk of each step of an episode.

    Args:
        poses: (T, 4, 4) TCP poses in the arm's base frame.
        opened: (T,) gripper commands as in ``gripper_status``: row t is the command that led to step t.
        steps: number of steps per chunk, K.

    Returns:
        (T, K, 10); rows after the end of the episode repeat the last pose and command.
    """
    length = len(poses)
    ahead = np.minimum(np.arange(length)[:, None] + np.arange(1, steps + 1), length - 1)  # (T, K)
    return _rows(inverse(poses)[:, None] @ poses[ahead], np.asarray(opened, np.float64)[ahead])


def next_key_poses(poses: Array, opened: NDArray[Any]) -> NDArray[np.float32]:
    """Return the next key poses (T, 9), encoded as in a chunk.

    The next key pose of a step is the TCP pose at the next change of the gripper command, or at the end of the episode.
    """
    length = len(poses)
    changes = np.flatnonzero(np.diff(np.asarray(opened, np.int8))).tolist()  # last steps before a change
    key_steps = np.array([next((change for change in changes if change >= t), length - 1) for t in range(length)])
    return _rows(inverse(poses) @ poses[key_steps], np.zeros(length))[:, :9]


def decode_chunk(rows: NDArray[np.floating], tcp: NDArray[np.floating]) -> tuple[Array, NDArray[np.float64]]:
    """Decode rows (..., 10) to poses (..., 4, 4) in the arm's base frame and gripper commands (...)."""
    rows = np.asarray(rows, np.float64)
    first = rows[..., 3:6] / np.maximum(np.linalg.norm(rows[..., 3:6], axis=-1, keepdims=True), 1e-9)
    second = rows[..., 6:9] - (first * rows[..., 6:9]).sum(-1, keepdims=True) * first
    second /= np.maximum(np.linalg.norm(second, axis=-1, keepdims=True), 1e-9)
    rotations = np.stack([first, second, np.cross(first, second)], axis=-1)
    return tcp @ from_rotation(rows[..., :3], rotations), rows[..., 9]


def _rows(poses: NDArray[np.floating], last: NDArray[np.floating]) -> NDArray[np.float32]:
    columns = poses[..., :3, :2].swapaxes(-1, -2).reshape(*poses.shape[:-2], 6)
    return np.concatenate([poses[..., :3, 3], columns, last[..., None]], axis=-1).astype(np.float32)


class Scale(torch.nn.Module):
    """Normalisation to mean 0 and deviation 1; its buffers are saved with the weights and not trained.

    Args:
        mean, deviation: nested lists of numbers, of the same shape.
    """

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(self, mean: Any, deviation: Any) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32))
        self.register_buffer("deviation", torch.tensor(deviation, dtype=torch.float32))

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return (values - self.mean) / self.deviation

    def inverse(self, values: torch.Tensor) -> torch.Tensor:
        """Undo the normalisation."""
        return values * self.deviation + self.mean


def scale_statistics(motions: NDArray[np.floating]) -> dict[str, Any]:
    """Return the arguments of a `Scale` for poses (N, ..., 9), per row of the chunk."""
    return {"mean": motions.mean(0).tolist(), "deviation": np.maximum(motions.std(0), _MIN_DEVIATION).tolist()}


class ChunkModel(Protocol):
    """Network that predicts chunks: loss weights in ``config``, scales of its predictions."""

    config: Any
    chunk_scale: Scale
    key_scale: Scale


def chunk_losses(model: ChunkModel, batch: Batch, chunk: torch.Tensor, key: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the losses of a batch: L1 of poses and key poses, cross entropy of gripper commands.

    The weight of a pose is near_distance / (near_distance + distance): 1 cm decides about a grasp and hardly matters
    half a metre away.

    Args:
        model: the network.
        batch: with labels ``chunk`` (B, K, 10) and ``key`` (B, 9), not normalised.
        chunk: (B, K, 10) predicted chunk: normalised poses, logits of the gripper commands.
        key: (B, 9) predicted key pose, normalised.

    Returns:
        ``loss`` and its terms ``motion``, ``gripper``, ``keys``; position errors in mm of the key pose (``key_mm``), of
        key poses within 5 cm (``near_mm``), of the first and the last step of the chunk.
    """
    config = model.config
    motion = _l1(chunk[..., :9], batch["chunk"][..., :9], model.chunk_scale, config.near_distance)
    gripper = F.binary_cross_entropy_with_logits(chunk[..., 9], batch["chunk"][..., 9])
    keys = _l1(key, batch["key"], model.key_scale, config.near_distance)
    with torch.no_grad():
        key_error = (model.key_scale.inverse(key) - batch["key"])[:, :3].norm(dim=1)
        near = (batch["key"][:, :3].norm(dim=1) < _NEAR).float()
        errors = (model.chunk_scale.inverse(chunk[..., :9]) - batch["chunk"][..., :9])[..., :3].norm(dim=-1)
    return {
        "loss": motion + config.gripper_weight * gripper + config.keys_weight * keys,
        "motion": motion,
        "gripper": gripper,
        "keys": keys,
        "key_mm": 1000 * key_error.mean(),
        "near_mm": torch.stack([1000 * (key_error * near).sum(), near.sum()]),
        "first_mm": 1000 * errors[:, 0].mean(),
        "last_mm": 1000 * errors[:, -1].mean(),
    }


def _l1(predicted: torch.Tensor, poses: torch.Tensor, scale: Scale, near_distance: float) -> torch.Tensor:
    """Return the mean error of normalised poses (..., 9), weighted by distance, see `chunk_losses`."""
    error = (predicted - scale(poses)).abs().mean(dim=-1)
    if not near_distance:
        return error.mean()
    weights = near_distance / (near_distance + poses[..., :3].norm(dim=-1))
    return (error * weights).sum() / weights.sum()


class ChunkPolicy:
    """Policy that executes predicted chunks, in the ``robocas`` action convention relative to the TCP.

    The policy executes a chunk for ``n_action_steps`` before the next prediction. A network that observes images
    without velocities takes every step for the slow start of a motion: with a prediction at each step it would creep
    and never close the gripper. The pose of a step is the mean of all predictions for it, weighted by
    exp(-temporal_ensemble_coeff * age). Age 0 is the newest prediction; in ACT (Zhao et al. 2023) the oldest prediction
    has the largest weight.

    Reopen heuristic: a gripper that closed on nothing and has stopped moving is opened. It is not learned: a failed
    grasp looks like pushing with a closed gripper, and the network would wait forever.

    Args:
        spec: specification of the policy; images are rendered for new chunks only.
        predict: function from observations and a row to a chunk (K, 10).
        n_action_steps: policy steps of a chunk that are executed before the next prediction, at most K.
        temporal_ensemble_coeff: decay of the weight of older predictions, per policy step.
        reopen: distance in m; an empty gripper that moved less during a chunk is opened. 0 switches it off.
        description: entries of `describe`.
    """

    def __init__(
        self,
        spec: PolicySpec,
        predict: Predict,
        n_action_steps: int,
        temporal_ensemble_coeff: float,
        reopen: float = 0.0,
        description: dict[str, Any] | None = None,
    ) -> None:
        self.spec, self._predict = replace(spec, observe_every=n_action_steps), predict
        self._description = description or {}
        self._n_action_steps, self._ensemble_coeff, self._reopen = n_action_steps, temporal_ensemble_coeff, reopen
        self._chunks: dict[int, list[_Chunk]] = {}  # by env, newest first
        self._chunk_start: dict[int, Array] = {}  # by env, (3,) TCP position at the last prediction, in the base frame

    def describe(self) -> dict[str, Any]:
        return self._description

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._chunks[episode.env] = []
            self._chunk_start.pop(episode.env, None)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        tcp = from_wxyz(observations.tcp_in_base)
        envs = observations.envs.tolist()
        for row, env in enumerate(envs):
            chunks = [replace(one, age=one.age + 1) for one in self._chunks[env] if one.age + 1 < len(one.poses)]
            if not chunks or chunks[0].age >= self._n_action_steps:
                rows = self._predict(
                    observations, row
                )  # one env at a time: in a batch, rounding depends on the other rows
                chunks.insert(0, _Chunk(*decode_chunk(rows, tcp[row])))
                if self._is_stuck(env, tcp[row, :3, 3], float(observations.robot[GRIPPER_WIDTH].reshape(-1)[row])):
                    chunks = [replace(one, opened=np.ones_like(one.opened)) for one in chunks]  # else outvoted
            self._chunks[env] = chunks
        return np.stack([self._next(self._chunks[env], here) for env, here in zip(envs, tcp, strict=True)])

    def _is_stuck(self, env: int, here: Array, width: float) -> bool:
        """Return whether an empty gripper has not moved since the last prediction; store its position."""
        before = self._chunk_start.get(env)
        self._chunk_start[env] = here.copy()
        return width < _EMPTY_WIDTH and before is not None and bool(np.linalg.norm(here - before) < self._reopen)

    def _next(self, chunks: list[_Chunk], here: Array) -> NDArray[np.float64]:
        weights = np.exp(-self._ensemble_coeff * np.array([one.age for one in chunks]))
        weights /= weights.sum()
        poses = np.stack([one.poses[one.age] for one in chunks])
        opened = float(weights @ [one.opened[one.age] for one in chunks])
        rotation = Rotation.from_matrix(poses[:, :3, :3]).mean(weights)
        now = Rotation.from_matrix(here[:3, :3]).inv()
        motion = now.apply(weights @ poses[:, :3, 3] - here[:3, 3])
        return np.array([*motion, *(now * rotation).as_euler("xyz"), float(opened > 0.5)])


@dataclass(frozen=True)
class _Chunk:
    """Decoded chunk: poses (K, 4, 4) in the arm's base frame, gripper commands (K,), age in policy steps."""

    poses: Array
    opened: NDArray[np.float64]
    age: int = 0
