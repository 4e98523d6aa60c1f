"""Loss of chunks: L1 of normalised poses, cross entropy of gripper commands, and L1 of the next key pose.

Near poses have more weight: a centimetre decides about a grasp, and hardly matters half a metre before it.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.chunks.poses import Scale

NEAR = 0.05
"""Distance in m below which the log calls a pose near."""


class _Weights(Protocol):
    @property
    def keys_weight(self) -> float: ...

    @property
    def gripper_weight(self) -> float: ...

    @property
    def near(self) -> float: ...


class Predictor(Protocol):
    """A network with the scales of its predictions."""

    config: Any
    chunk_scale: Scale
    key_scale: Scale


def chunk_losses(model: Predictor, batch: Batch, chunk: torch.Tensor, key: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the losses of a batch.

    Args:
        model: the network.
        batch: with ``chunk`` (B, K, 10) and ``key`` (B, 9), not normalised.
        chunk: (B, K, 10) predicted, normalised but for the logits of the commands.
        key: (B, 9) predicted, normalised.

    Returns:
        ``loss``, its parts, and errors of positions in mm: of the key pose, of one nearer than `NEAR`, of the first
        and the last step.
    """
    weights: _Weights = model.config
    motion = _l1(chunk[..., :9], batch["chunk"][..., :9], model.chunk_scale, weights.near)
    gripper = F.binary_cross_entropy_with_logits(chunk[..., 9], batch["chunk"][..., 9])
    keys = _l1(key, batch["key"], model.key_scale, weights.near)
    with torch.no_grad():
        off = (model.key_scale.back(key) - batch["key"])[:, :3].norm(dim=1)
        near = (batch["key"][:, :3].norm(dim=1) < NEAR).float()
        ahead = (model.chunk_scale.back(chunk[..., :9]) - batch["chunk"][..., :9])[..., :3].norm(dim=-1)
    return {
        "loss": motion + weights.gripper_weight * gripper + weights.keys_weight * keys,
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
