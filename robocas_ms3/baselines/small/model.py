"""The network of `small`: a convolutional net a camera, and a transformer that asks them what it needs to know.

Feature maps at a sixteenth of the pictures' size are what its queries look at: one query a step of the chunk, one for
the next key pose. Language and the arm's state are part of what is looked at; language also tells the nets what to look
for, by a scale and shift of each channel (FiLM, Perez et al. 2018). A pointer in each picture finds where the gripper
will close or open next, and what is there is a token too.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.chunk_loss import chunk_losses
from robocas_ms3.baselines.chunks import ROW, Scale
from robocas_ms3.baselines.small.config import SmallConfig, View
from robocas_ms3.baselines.small.pointing import CELL, Pointer, pointing_losses

_WORDS, _STATE = 384, 10


class Block(nn.Module):
    """A residual block (He et al. 2016) whose channels language scales and shifts."""

    def __init__(self, inputs: int, outputs: int, stride: int, words: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.second = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norms = nn.ModuleList([nn.GroupNorm(8, outputs), nn.GroupNorm(8, outputs)])
        self.short = nn.Identity() if stride == 1 and inputs == outputs else nn.Conv2d(inputs, outputs, 1, stride)
        self.film = nn.Linear(words, 2 * outputs)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)

    def forward(self, seen: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
        """(B, C, h, w) of (B, c, H, W) and words (B, W)."""
        inner = self.norms[1](self.second(F.relu(self.norms[0](self.first(seen)))))
        scale, shift = self.film(words)[:, :, None, None].chunk(2, dim=1)
        return F.relu(inner * (1 + scale) + shift + self.short(seen))


class Eye(nn.Module):
    """Tokens of a camera's pictures, and where in them the gripper will close or open next (`Pointer`)."""

    def __init__(self, view: View, channels: int, width: int, words: int) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, channels, 4, 4)
        self.norm = nn.GroupNorm(8, channels)
        self.blocks = nn.ModuleList(
            [
                Block(channels, channels, 1, words),
                Block(channels, 2 * channels, 2, words),
                Block(2 * channels, 4 * channels, 2, words),
            ]
        )
        self.project, self.down = nn.Conv2d(4 * channels, width, 1), nn.Conv2d(4 * channels, 2 * channels, 1)
        self.pointer = Pointer(view, 2 * channels, width)
        self.places = nn.Parameter(torch.randn(view.size[0] * view.size[1] // 256, width) * 0.2)

    def forward(
        self, pictures: torch.Tensor, words: torch.Tensor, asked: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, h w / 256 + 1, width), and logits (B, h w / 64), of pictures (B, 3, h, w) around 0."""
        fine = F.relu(self.norm(self.stem(pictures)))
        for block in self.blocks[:2]:
            fine = block(fine, words)
        coarse = self.blocks[2](fine, words)
        pointed, logits = self.pointer(fine + F.interpolate(self.down(coarse), scale_factor=2), asked)
        tokens = self.project(coarse).flatten(2).transpose(1, 2) + self.places
        return torch.cat([tokens, pointed[:, None]], dim=1), logits


class SmallModel(nn.Module):
    """See the module; predicts chunks (B, K, 10) and key poses (B, 9)."""

    def __init__(self, config: SmallConfig, facts: dict[str, Any]) -> None:
        super().__init__()
        self.config, width = config, config.width
        self.chunk_scale, self.key_scale = Scale(**facts["chunk"]), Scale(**facts["keys"])
        self.word_scale = Scale(**facts["words"])
        self.words = nn.Sequential(nn.Linear(_WORDS, width), nn.ReLU(), nn.Dropout(config.dropout))
        self.state = nn.Sequential(nn.Linear(_STATE, width), nn.ReLU(), nn.Linear(width, width))
        self.eyes = nn.ModuleDict(
            {camera: Eye(view, config.channels, width, width) for camera, view in config.views.items()}
        )
        self.queries = nn.Parameter(torch.randn(config.chunk + 1, width) * 0.2)
        layer = nn.TransformerDecoderLayer(
            width, config.heads, 4 * width, config.dropout, batch_first=True, norm_first=True
        )
        self.decoder = nn.TransformerDecoder(layer, config.layers, nn.LayerNorm(width))
        self.out, self.key_out = nn.Linear(width, ROW), nn.Linear(width, 9)

    def predict(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """Normalised chunks (B, K, 10) with commands' logits, normalised keys (B, 9), logits of cells by camera."""
        words = self.words(self.word_scale(batch["words"]).clamp(-3, 3))
        state = self.state(batch["state"])
        asked = words + state
        seen = {camera: eye(self._picture(batch[camera]), words, asked) for camera, eye in self.eyes.items()}
        memory = torch.cat([*(tokens for tokens, _ in seen.values()), words[:, None], state[:, None]], dim=1)
        queries = self.queries + asked[:, None]
        thought = self.decoder(queries, memory)
        cells = {camera: logits for camera, (_, logits) in seen.items()}
        return self.out(thought[:, :-1]).float(), self.key_out(thought[:, -1]).float(), cells

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Losses, see `chunk_losses` and `pointing_losses`."""
        chunk, key, cells = self.predict(batch)
        found = chunk_losses(self, batch, chunk, key)
        for camera, view in self.config.views.items():
            loss, right = pointing_losses(cells[camera], batch[f"{camera}_cell"], view.size[0] // CELL)
            found["loss"] = found["loss"] + self.config.point_weight * loss
            found |= {f"{camera}_point": loss, f"{camera}_found": right}
        return found

    def act(self, batch: Batch) -> torch.Tensor:
        """(B, K, 10) chunks: poses as they are, commands as shares, 1 = open."""
        chunk, _, _ = self.predict(batch)
        return torch.cat([self.chunk_scale.back(chunk[..., :9]), chunk[..., 9:].sigmoid()], dim=-1)

    def _picture(self, pictures: torch.Tensor) -> torch.Tensor:
        """(B, 3, h, w) around 0 of (B, h, w, 3) uint8; in training shifted and in another light, each its own way."""
        if self.training and self.config.shift:
            pictures = shifted(pictures, self.config.shift)
        seen = pictures.permute(0, 3, 1, 2).contiguous().float() / 127.5 - 1  # norms are slow where channels are last
        if self.training and self.config.brightness:
            amount = self.config.brightness * (2 * torch.rand(2, len(seen), 1, 1, 1, device=seen.device) - 1)
            seen = seen * (1 + amount[0]) + amount[1]
        return seen


def shifted(pictures: torch.Tensor, most: int) -> torch.Tensor:
    """Pictures (B, h, w, C) shifted by up to ``most`` pixels each way, each its own way; edges go on outwards."""
    count, height, width, _ = pictures.shape
    device = pictures.device
    by = torch.randint(-most, most + 1, (2, count, 1), device=device)
    rows = (by[0] + torch.arange(height, device=device)).clamp(0, height - 1)  # (B, h)
    columns = (by[1] + torch.arange(width, device=device)).clamp(0, width - 1)
    picked = torch.arange(count, device=device)[:, None, None]
    return pictures[picked, rows[:, :, None], columns[:, None, :]]
