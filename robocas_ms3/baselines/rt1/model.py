"""The network of RT-1 (Brohan et al. 2022): image tokens of a history of frames, a transformer, tokens of actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.image import ImageEncoder
from robocas_ms3.core.errors import TrainingError

CONTINUE, TERMINATE = 0, 1
"""Tokens of whether an episode ends; they are predicted by the first two logits of the bins, as in RT-1."""
ACTION_TOKENS = 7
FRAME_TOKENS = ACTION_TOKENS + 1
"""Seven numbers of an action, and whether the episode ends."""


class ActionBins(nn.Module):
    """Bins of equal width over the ranges of the motion; over 0..1 for the gripper.

    A number beyond its range falls into the first or last bin; an axis without a range has but one value.

    Args:
        low, high: (6,) ends of the motion's ranges, m and rad.
        bins: of each number.
    """

    low: torch.Tensor
    span: torch.Tensor

    def __init__(self, low: Sequence[float], high: Sequence[float], bins: int) -> None:
        super().__init__()
        self.bins = bins
        ends = torch.tensor([[*low, 0.0], [*high, 1.0]], dtype=torch.float64)
        self.register_buffer("low", ends[0].float(), persistent=False)
        self.register_buffer("span", (ends[1] - ends[0]).clamp(min=0).float(), persistent=False)

    def encode(self, actions: torch.Tensor) -> torch.Tensor:
        """Return int64 tokens (..., 7) of actions (..., 7)."""
        share = (actions - self.low) / torch.where(self.span > 0, self.span, 1.0)
        return (share * self.bins).floor().clamp(0, self.bins - 1).long()

    def decode(self, tokens: torch.Tensor) -> torch.Tensor:
        """Return actions (..., 7): the middles of the bins."""
        return self.low + (tokens + 0.5) / self.bins * self.span


class Layer(nn.Module):
    """Attention and a linear map, each with a residual connection; RT-1's feed-forward layer is this one map."""

    def __init__(self, config: RT1Config) -> None:
        super().__init__()
        inner = config.heads * config.key_width
        self.heads, self.dropout = config.heads, config.dropout
        self.norm, self.feed_norm = nn.LayerNorm(config.width, eps=1e-6), nn.LayerNorm(config.width, eps=1e-6)
        self.ask, self.answer = nn.Linear(config.width, 3 * inner), nn.Linear(inner, config.width)
        self.feed = nn.Linear(config.width, config.width)

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Return (B, L, width) for the same; ``mask`` (L, L) says which row attends to which column."""
        projected = self.ask(self.norm(tokens)).unflatten(-1, (3, self.heads, -1))
        query, key, value = projected.permute(2, 0, 3, 1, 4)  # (B, heads, L, key width) each
        dropout = self.dropout if self.training else 0.0
        found = F.scaled_dot_product_attention(query, key, value, attn_mask=mask, dropout_p=dropout)
        tokens = tokens + self.answer(found.transpose(1, 2).flatten(2))
        return tokens + F.dropout(self.feed(self.feed_norm(tokens)), self.dropout, self.training)


class Transformer(nn.Module):
    """Logits of the tokens of an action for each frame.

    A frame is the image tokens of its cameras and a place for each token to predict. A token attends to image tokens
    before it, and to itself if it is one; as in RT-1, predicted tokens are not attended to, so all are predicted at
    once.
    """

    seen: torch.Tensor

    def __init__(self, config: RT1Config) -> None:
        super().__init__()
        images = len(config.cameras) * config.image_tokens
        self.frames, self.images = config.frames, images
        self.enter = nn.Linear(config.token_width, config.width)
        self.places = nn.Parameter(torch.randn(config.frames * (images + FRAME_TOKENS), config.width) * 0.02)
        self.layers = nn.ModuleList([Layer(config) for _ in range(config.layers)])
        self.leave = nn.Linear(config.width, config.bins)
        self.register_buffer("seen", attention_mask(config.frames, images, FRAME_TOKENS), persistent=False)

    def forward(self, image_tokens: torch.Tensor) -> torch.Tensor:
        """Return (B, frames, 8, bins) for image tokens (B, frames, images, token_width)."""
        entered = self.enter(image_tokens)
        empty = entered.new_zeros(len(entered), self.frames, FRAME_TOKENS, entered.shape[-1])
        tokens = torch.cat([entered, empty], dim=2).flatten(1, 2) + self.places
        for layer in self.layers:
            tokens = layer(tokens, self.seen)
        return self.leave(tokens.unflatten(1, (self.frames, -1))[:, :, self.images :])


def attention_mask(frames: int, images: int, predicted: int) -> torch.Tensor:
    """Return (L, L) bool: which token of a sequence (row) attends to which (column)."""
    is_image = torch.arange(frames * (images + predicted)) % (images + predicted) < images
    return torch.ones(len(is_image), len(is_image), dtype=torch.bool).tril() & is_image


class RT1Model(nn.Module):
    """Predicts the action of each frame."""

    mean: torch.Tensor
    std: torch.Tensor
    from_imagenet: torch.Tensor
    """Whether the encoders started from the weights of a file; saved with the weights."""

    def __init__(self, config: RT1Config, facts: dict[str, Any]) -> None:
        super().__init__()
        self.config = config
        self.bins = ActionBins(facts["action_low"], facts["action_high"], config.bins)
        encoders = [ImageEncoder(config) for _ in config.cameras]
        self.encoders = nn.ModuleList(encoders)
        self.transformer = Transformer(config)
        for name, value in (("mean", config.image_mean), ("std", config.std)):
            self.register_buffer(name, 255 * torch.tensor(value).view(3, 1, 1), persistent=False)
        has_weights = config.image_weights is not None and config.image_weights.is_file()
        if config.image_weights is not None and has_weights:
            for encoder in encoders:
                encoder.load_efficientnet(config.image_weights)
        self.register_buffer("from_imagenet", torch.tensor(has_weights))

    def encode(self, images: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return tokens (N, images, token_width) of images (N, cameras, 3, h, w) uint8 and embeddings (N, 384)."""
        scaled = (crop_rows(images, self.config.crop_height, anywhere=self.training) - self.mean) / self.std
        return torch.cat([encoder(scaled[:, view], language) for view, encoder in enumerate(self.encoders)], dim=1)

    def logits(self, batch: Batch) -> torch.Tensor:
        """Return (B, frames, 8, bins) for a batch, see `RT1Samples`."""
        images, language = batch["rgb"], batch["language"]
        frames = images.shape[1]
        tokens = self.encode(images.flatten(0, 1), language.repeat_interleave(frames, dim=0))
        return self.transformer(tokens.unflatten(0, (-1, frames))).float()

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Return the cross entropy, and the accuracy of tokens: of actions, of the gripper, of the end."""
        if self.training and self.config.image_weights is not None and not self.from_imagenet:
            raise TrainingError("no such file", where=f"image_weights {self.config.image_weights}")
        logits, mask = self.logits(batch), batch["mask"]
        end = torch.where(batch["terminate"], TERMINATE, CONTINUE)
        wanted = torch.cat([self.bins.encode(batch["action"]), end[..., None]], dim=-1)
        losses = F.cross_entropy(logits.flatten(0, 2), wanted.flatten(), reduction="none").view_as(wanted)
        with torch.no_grad():
            right = (likeliest_tokens(logits) == wanted).float()
        return {
            "loss": _mean(losses, mask),
            "action_accuracy": _mean(right[..., :ACTION_TOKENS], mask),
            "gripper_accuracy": _mean(right[..., ACTION_TOKENS - 1 : ACTION_TOKENS], mask),
            "terminate_accuracy": _mean(right[..., ACTION_TOKENS:], mask),
        }

    def act(self, tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (B, 7) and whether they end the episode (B,), for tokens (B, frames, images, token_width)."""
        predicted = likeliest_tokens(self.transformer(tokens)[:, -1].float())
        return self.bins.decode(predicted[:, :ACTION_TOKENS]), predicted[:, ACTION_TOKENS] == TERMINATE


def likeliest_tokens(logits: torch.Tensor) -> torch.Tensor:
    """Return tokens (..., 8) for logits (..., 8, bins); for the end one of its two."""
    action, end = logits[..., :ACTION_TOKENS, :], logits[..., ACTION_TOKENS:, : TERMINATE + 1]
    return torch.cat([action.argmax(-1), end.argmax(-1)], dim=-1)


def crop_rows(images: torch.Tensor, height: int, *, anywhere: bool) -> torch.Tensor:
    """Return rows (..., 3, height, w) of images (..., 3, h, w) as float32: the middle ones, or any per image."""
    spare = images.shape[-2] - height
    if not anywhere:
        first = spare // 2
        return images[..., first : first + height, :].float()
    flat = images.flatten(0, -4)
    start = torch.randint(0, spare + 1, (len(flat), 1), device=flat.device)
    rows = start + torch.arange(height, device=flat.device)  # (N, height)
    rows = rows[:, None, :, None].expand(-1, 3, -1, flat.shape[-1])
    return flat.gather(2, rows).view(*images.shape[:-2], height, -1).float()


def _mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return the mean of values (B, frames, K) where the mask (B, frames) holds."""
    return (values * mask[..., None]).sum() / (mask.sum() * values.shape[-1]).clamp(min=1)
