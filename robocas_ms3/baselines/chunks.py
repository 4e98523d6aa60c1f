"""Chunks of future TCP poses: their encoding, loss and policy, shared by `small` and `bc_state`.

A row of a chunk is (10,): position in m and the first two columns of the rotation matrix (Zhou et al. 2019), both in
the present frame of the TCP; and the gripper command, 1 = open. Unlike chained motions, poses do not depend on how far
the TCP came with the last action, so errors of the controller are corrected.
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
_MIN_DEVIATION = np.array([0.004] * 3 + [0.02] * 6)  # m and 1: smaller deviations are noise
_NEAR = 0.05  # m; closer poses have a metric of their own
_EMPTY = 0.004  # m, width of a gripper that has closed on nothing

Predict = Callable[[Observations, int], NDArray[np.floating]]


def state_of(poses: NDArray[np.floating], widths: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return proprioception (N, 10) of TCP poses (N, 4, 4) in the arm's base and gripper widths (N,) in m."""
    return _rows(poses, widths / 0.08)


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
    """Return poses (..., 4, 4) in the arm's base, and commands, of rows (..., 10) seen from a TCP's pose there."""
    rows = np.asarray(rows, np.float64)
    first = rows[..., 3:6] / np.maximum(np.linalg.norm(rows[..., 3:6], axis=-1, keepdims=True), 1e-9)
    second = rows[..., 6:9] - (first * rows[..., 6:9]).sum(-1, keepdims=True) * first
    second /= np.maximum(np.linalg.norm(second, axis=-1, keepdims=True), 1e-9)
    turns = np.stack([first, second, np.cross(first, second)], axis=-1)
    return tcp @ from_rotation(rows[..., :3], turns), rows[..., 9]


def _rows(poses: NDArray[np.floating], last: NDArray[np.floating]) -> NDArray[np.float32]:
    turns = poses[..., :3, :2].swapaxes(-1, -2).reshape(*poses.shape[:-2], 6)
    return np.concatenate([poses[..., :3, 3], turns, last[..., None]], axis=-1).astype(np.float32)


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
        return (values - self.mean) / self.deviation

    def back(self, values: torch.Tensor) -> torch.Tensor:
        """Return values that are not normalised any more."""
        return values * self.deviation + self.mean


def spread(motions: NDArray[np.floating]) -> dict[str, Any]:
    """Return the arguments of a `Scale` of poses (..., N, 9), per row of the chunk."""
    return {"mean": motions.mean(0).tolist(), "deviation": np.maximum(motions.std(0), _MIN_DEVIATION).tolist()}


class ChunkModel(Protocol):
    """A network of chunks: ``config`` has the weights of its losses, the scales normalise its predictions."""

    config: Any
    chunk_scale: Scale
    key_scale: Scale


def chunk_losses(model: ChunkModel, batch: Batch, chunk: torch.Tensor, key: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the losses of a batch: L1 of poses and key poses, cross entropy of gripper commands.

    Near poses have more weight: a centimetre decides about a grasp, and hardly matters half a metre before it.

    Args:
        model: the network.
        batch: with ``chunk`` (B, K, 10) and ``key`` (B, 9), not normalised.
        chunk: (B, K, 10) predicted, normalised but for the logits of the commands.
        key: (B, 9) predicted, normalised.

    Returns:
        ``loss``, its parts, and errors of positions in mm: of the key pose, of those within 5 cm, of the first and the
        last step.
    """
    config = model.config
    motion = _l1(chunk[..., :9], batch["chunk"][..., :9], model.chunk_scale, config.near)
    gripper = F.binary_cross_entropy_with_logits(chunk[..., 9], batch["chunk"][..., 9])
    keys = _l1(key, batch["key"], model.key_scale, config.near)
    with torch.no_grad():
        off = (model.key_scale.back(key) - batch["key"])[:, :3].norm(dim=1)
        near = (batch["key"][:, :3].norm(dim=1) < _NEAR).float()
        ahead = (model.chunk_scale.back(chunk[..., :9]) - batch["chunk"][..., :9])[..., :3].norm(dim=-1)
    return {
        "loss": motion + config.gripper_weight * gripper + config.keys_weight * keys,
        "motion": motion,
        "gripper": gripper,
        "keys": keys,
        "key_mm": 1000 * off.mean(),
        "near_mm": torch.stack([1000 * (off * near).sum(), near.sum()]),
        "first_mm": 1000 * ahead[:, 0].mean(),
        "last_mm": 1000 * ahead[:, -1].mean(),
    }


def _l1(found: torch.Tensor, poses: torch.Tensor, scale: Scale, near: float) -> torch.Tensor:
    """Return the mean error of normalised poses (..., 9), weighted by near / (near + distance); 0: no weights."""
    error = (found - scale(poses)).abs().mean(dim=-1)
    if not near:
        return error.mean()
    weights = near / (near + poses[..., :3].norm(dim=-1))
    return (error * weights).sum() / weights.sum()


class ChunkPolicy:
    """Acts in RoboCAS' convention of seven numbers, relative to the TCP.

    The policy follows a chunk for some steps before it predicts the next one. A network that sees images and no
    velocities takes each pause for the slow start of a motion: asked at every step, it would creep, and never close
    the gripper. The pose of a step is the mean of its predictions, weighted by exp(-fade age) (Zhao et al. 2023 weight
    the oldest most; at 5 Hz the newest is better).

    The reopen heuristic is not learned: a gripper that closed on nothing and has not moved since the last chunk is
    opened. A failed grasp looks like pushing with a closed gripper, and the network would wait for ever.

    Args:
        spec: of the policy; images are rendered for new chunks only.
        predict: returns a (K, 10) chunk for observations and a row of them.
        play: steps of a chunk before the next one, up to K.
        fade: decay of the weight of older predictions, per step.
        reopen: distance in m; an empty gripper that moved less during a chunk is opened. 0: never.
        about: what results record about the policy.
    """

    def __init__(
        self,
        spec: PolicySpec,
        predict: Predict,
        play: int,
        fade: float,
        reopen: float = 0.0,
        about: dict[str, Any] | None = None,
    ) -> None:
        self.spec, self._predict, self._about = replace(spec, observe_every=play), predict, about or {}
        self._play, self._fade, self._reopen = play, fade, reopen
        self._plans: dict[int, list[_Plan]] = {}  # by env, newest first
        self._chunk_start: dict[int, Array] = {}  # by env, (3,) where the TCP was in the arm's base

    def describe(self) -> dict[str, Any]:
        return self._about

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._plans[episode.env] = []
            self._chunk_start.pop(episode.env, None)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        tcp = from_wxyz(observations.tcp_in_base)
        envs = observations.envs.tolist()
        for row, env in enumerate(envs):
            plans = [replace(plan, age=plan.age + 1) for plan in self._plans[env] if plan.age + 1 < len(plan.poses)]
            if not plans or plans[0].age >= self._play:
                chunk = self._predict(observations, row)  # alone: in a batch, its last bits depend on the other rows
                plans.insert(0, _Plan(*decode(chunk, tcp[row])))
                if self._is_stuck(env, tcp[row, :3, 3], float(observations.robot[GRIPPER_WIDTH].reshape(-1)[row])):
                    plans = [replace(plan, opened=np.ones_like(plan.opened)) for plan in plans]  # else outvoted
            self._plans[env] = plans
        return np.stack([self._next(self._plans[env], here) for env, here in zip(envs, tcp, strict=True)])

    def _is_stuck(self, env: int, here: Array, width: float) -> bool:
        """Return whether an empty gripper has not moved since the last chunk; stores its position."""
        before = self._chunk_start.get(env)
        self._chunk_start[env] = here.copy()
        return width < _EMPTY and before is not None and bool(np.linalg.norm(here - before) < self._reopen)

    def _next(self, plans: list[_Plan], here: Array) -> NDArray[np.float64]:
        weights = np.exp(-self._fade * np.array([plan.age for plan in plans]))
        weights /= weights.sum()
        poses = np.stack([plan.poses[plan.age] for plan in plans])
        opened = float(weights @ [plan.opened[plan.age] for plan in plans])
        turn = Rotation.from_matrix(poses[:, :3, :3]).mean(weights)
        now = Rotation.from_matrix(here[:3, :3]).inv()
        motion = now.apply(weights @ poses[:, :3, 3] - here[:3, 3])
        return np.array([*motion, *(now * turn).as_euler("xyz"), float(opened > 0.5)])


@dataclass(frozen=True)
class _Plan:
    """A decoded chunk: (K, 4, 4) poses in the arm's base, (K,) gripper commands, and its age in steps."""

    poses: Array
    opened: NDArray[np.float64]
    age: int = 0
