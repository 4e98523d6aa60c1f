"""What chunks are trained by: L1 of normalised poses, cross entropy of the gripper's commands, the next key pose."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.chunks import Scale


class _Weights(Protocol):
    @property
    def keys_weight(self) -> float: ...

    @property
    def gripper_weight(self) -> float: ...


class Predictor(Protocol):
    """A network with the scales of what it predicts."""

    config: Any
    chunk_scale: Scale
    key_scale: Scale


def chunk_losses(model: Predictor, batch: Batch, chunk: torch.Tensor, key: torch.Tensor) -> dict[str, torch.Tensor]:
    """Losses of a batch.

    Args:
        model: that predicted.
        batch: with ``chunk`` (B, K, 10) and ``key`` (B, 9), as they are.
        chunk: (B, K, 10) predicted, normalised but for the logits of the commands.
        key: (B, 9) predicted, normalised.

    Returns:
        ``loss``, its parts, and errors of positions in mm: of the key pose, the first and the last step.
    """
    weights: _Weights = model.config
    motion = F.l1_loss(chunk[..., :9], model.chunk_scale(batch["chunk"][..., :9]))
    gripper = F.binary_cross_entropy_with_logits(chunk[..., 9], batch["chunk"][..., 9])
    keys = F.l1_loss(key, model.key_scale(batch["key"]))
    with torch.no_grad():
        off = (model.key_scale.back(key) - batch["key"])[:, :3].norm(dim=1).mean()
        ahead = (model.chunk_scale.back(chunk[..., :9]) - batch["chunk"][..., :9])[..., :3].norm(dim=-1)
    return {
        "loss": motion + weights.gripper_weight * gripper + weights.keys_weight * keys,
        "motion": motion,
        "gripper": gripper,
        "keys": keys,
        "key_mm": 1000 * off,
        "first_mm": 1000 * ahead[:, 0].mean(),
        "last_mm": 1000 * ahead[:, -1].mean(),
    }
