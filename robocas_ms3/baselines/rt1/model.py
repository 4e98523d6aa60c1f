"""The network of `rt1`: an image encoder a camera, whose tokens of some frames a transformer turns into actions."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.image import ImageEncoder
from robocas_ms3.baselines.rt1.image_weights import load_image_weights
from robocas_ms3.baselines.rt1.tokens import ACTION_TOKENS, GO_ON, OVER, ActionBins
from robocas_ms3.baselines.rt1.transformer import Transformer
from robocas_ms3.core.errors import TrainingError


class RT1Model(nn.Module):
    """See the module.

    Args:
        config: its sizes.
        facts: of the data, see `data.RT1Samples`.

    Raises:
        TrainingError: ``image_weights`` is there, but not what it should be. Where there is no such file, only training
            says so: who has trained weights needs none.
    """

    mean: torch.Tensor
    std: torch.Tensor
    from_imagenet: torch.Tensor
    """Whether the encoders began with the weights of a file; kept with the weights."""

    def __init__(self, config: RT1Config, facts: dict[str, Any]) -> None:
        super().__init__()
        self.config = config
        self.bins = ActionBins(facts["action_low"], facts["action_high"], config.bins)
        self.encoders = nn.ModuleList([ImageEncoder(config) for _ in config.cameras])
        self.transformer = Transformer(config)
        for name, value in (("mean", config.image_mean), ("std", config.std)):
            self.register_buffer(name, 255 * torch.tensor(value).view(3, 1, 1), persistent=False)
        path = config.image_weights
        found = path if path is not None and path.is_file() else None
        if found is not None:
            load_image_weights([encoder.get_submodule("net") for encoder in self.encoders], found)
        self.register_buffer("from_imagenet", torch.tensor(found is not None))

    def encode(self, pictures: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """(N, images, token_width) tokens of frames.

        Args:
            pictures: (N, cameras, 3, height, width) uint8.
            language: (N, 384) embeddings.
        """
        seen = (cropped(pictures, self.config.crop_height, anywhere=self.training) - self.mean) / self.std
        return torch.cat([encoder(seen[:, view], language) for view, encoder in enumerate(self.encoders)], dim=1)

    def logits(self, batch: Batch) -> torch.Tensor:
        """(B, frames, 8, bins) of a batch, see `data.RT1Samples`."""
        pictures, language = batch["rgb"], batch["language"]
        frames = pictures.shape[1]
        tokens = self.encode(pictures.flatten(0, 1), language.repeat_interleave(frames, dim=0))
        return self.transformer(tokens.unflatten(0, (-1, frames))).float()

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Cross entropy, and shares of tokens that are right: all of actions, the gripper's, the end's.

        Raises:
            TrainingError: it is to learn from weights that were not there.
        """
        if self.training and self.config.image_weights is not None and not self.from_imagenet:
            raise TrainingError("no such file", where=f"image_weights {self.config.image_weights}")
        logits, mask = self.logits(batch), batch["mask"]
        over = torch.where(batch["terminate"], OVER, GO_ON)
        wanted = torch.cat([self.bins.encode(batch["action"]), over[..., None]], dim=-1)
        losses = F.cross_entropy(logits.flatten(0, 2), wanted.flatten(), reduction="none").view_as(wanted)
        with torch.no_grad():
            right = (chosen(logits) == wanted).float()
        return {
            "loss": _mean(losses, mask),
            "action_accuracy": _mean(right[..., :ACTION_TOKENS], mask),
            "gripper_accuracy": _mean(right[..., ACTION_TOKENS - 1 : ACTION_TOKENS], mask),
            "terminate_accuracy": _mean(right[..., ACTION_TOKENS:], mask),
        }

    def act(self, tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, 7) actions of the last frames and (B,) bool whether they are the last ones.

        Args:
            tokens: (B, frames, images, token_width) as `encode` gives them.
        """
        said = chosen(self.transformer(tokens)[:, -1].float())
        return self.bins.decode(said[:, :ACTION_TOKENS]), said[:, ACTION_TOKENS] == OVER


def chosen(logits: torch.Tensor) -> torch.Tensor:
    """(..., 8) the likeliest tokens of logits (..., 8, bins); of the end's, one of its two."""
    action, end = logits[..., :ACTION_TOKENS, :], logits[..., ACTION_TOKENS:, : OVER + 1]
    return torch.cat([action.argmax(-1), end.argmax(-1)], dim=-1)


def cropped(pictures: torch.Tensor, height: int, *, anywhere: bool) -> torch.Tensor:
    """(..., 3, height, w) rows of pictures (..., 3, h, w) as float32: the middle ones, or of each picture any."""
    spare = pictures.shape[-2] - height
    if not anywhere:
        first = spare // 2
        return pictures[..., first : first + height, :].float()
    flat = pictures.flatten(0, -4)
    start = torch.randint(0, spare + 1, (len(flat), 1), device=flat.device)
    rows = start + torch.arange(height, device=flat.device)  # (N, height)
    rows = rows[:, None, :, None].expand(-1, 3, -1, flat.shape[-1])
    return flat.gather(2, rows).view(*pictures.shape[:-2], height, -1).float()


def _mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Mean of values (B, frames, K) where the mask (B, frames) holds, as it does for each present step."""
    return (values * mask[..., None]).sum() / (mask.sum() * values.shape[-1]).clamp(min=1)
