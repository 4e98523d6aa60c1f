"""The network of `bc-state`: residual layers from what a simulator knows to a chunk."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.bc_state.config import BcStateConfig
from robocas_ms3.baselines.chunks.loss import chunk_losses
from robocas_ms3.baselines.chunks.poses import ROW, Scale


class BcStateModel(nn.Module):
    """See the module."""

    def __init__(self, config: BcStateConfig, facts: dict[str, Any]) -> None:
        super().__init__()
        self.config, width = config, config.width
        self.input_scale = Scale(**facts["inputs"])
        self.chunk_scale, self.key_scale = Scale(**facts["chunk"]), Scale(**facts["keys"])
        self.into = nn.Linear(len(facts["inputs"]["mean"]), width)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(width),
                nn.Linear(width, 2 * width),
                nn.GELU(),
                nn.Dropout(config.dropout),
                nn.Linear(2 * width, width),
            )
            for _ in range(config.blocks)
        )
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, config.chunk * ROW + 9))

    def predict(self, told: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Chunks (B, K, 10), normalised but for the logits of the commands, and normalised key poses (B, 9)."""
        seen = self.input_scale(told).clamp(-5, 5)
        if self.training and self.config.noise:
            seen = seen + self.config.noise * torch.randn_like(seen)
        inner = self.into(seen)
        for block in self.blocks:
            inner = inner + block(inner)
        found = self.out(inner).float()
        return found[:, :-9].reshape(len(told), self.config.chunk, ROW), found[:, -9:]

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Losses, see `chunk_losses`."""
        return chunk_losses(self, batch, *self.predict(batch["told"]))

    def act(self, told: torch.Tensor) -> torch.Tensor:
        """(B, K, 10) chunks: poses as they are, commands as shares, 1 = open."""
        chunk, _ = self.predict(told)
        return torch.cat([self.chunk_scale.back(chunk[..., :9]), chunk[..., 9:].sigmoid()], dim=-1)
