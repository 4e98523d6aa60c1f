"""Network of RT-1 (Brohan et al. 2022): image encoders, transformer and action tokens."""

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
"""Values of the terminate token; it is predicted by the first two logits of the bins, as in RT-1."""
ACTION_TOKENS = 7
FRAME_TOKENS = ACTION_TOKENS + 1
"""Predicted tokens per frame: seven of an action, and the terminate token."""


class ActionBins(nn.Module):
    """Convert actions to tokens and back: each axis has bins of equal width over its range.

    The range of the gripper command is 0..1. A value outside the range is in the first or last bin. If the limits of an
    axis are equal, its decoded value is constant.

    Args:
        low, high: (6,) limits of the translation in m and of the Euler angles in rad, per policy step.
        bins: number of bins per axis.
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
        """Return the bin indices (..., 7) int64 of actions (..., 7)."""
        fraction = (actions - self.low) / torch.where(self.span > 0, self.span, 1.0)
        return (fraction * self.bins).floor().clamp(0, self.bins - 1).long()

    def decode(self, tokens: torch.Tensor) -> torch.Tensor:
        """Return actions (..., 7), the centres of the bins with these indices (..., 7)."""
        return self.low + (tokens + 0.5) / self.bins * self.span


class TransformerLayer(nn.Module):
    """Transformer layer whose feed-forward part is a single linear layer, as in RT-1."""

    def __init__(self, config: RT1Config) -> None:
        super().__init__()
        inner = config.heads * config.key_width
        self.heads, self.dropout = config.heads, config.dropout
        self.norm, self.feed_forward_norm = nn.LayerNorm(config.width, eps=1e-6), nn.LayerNorm(config.width, eps=1e-6)
        self.qkv, self.output = nn.Linear(config.width, 3 * inner), nn.Linear(inner, config.width)
        self.feed_forward = nn.Linear(config.width, config.width)

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Return the next tokens (B, L, width).

        tokens: (B, L, width). mask: (L, L) bool; token i attends to token j if ``mask[i, j]``.
        """
        projected = self.qkv(self.norm(tokens)).unflatten(-1, (3, self.heads, -1))
        query, key, value = projected.permute(2, 0, 3, 1, 4)  # (B, heads, L, key width) each
        dropout = self.dropout if self.training else 0.0
        attended = F.scaled_dot_product_attention(query, key, value, attn_mask=mask, dropout_p=dropout)
        tokens = tokens + self.output(attended.transpose(1, 2).flatten(2))
        return tokens + F.dropout(self.feed_forward(self.feed_forward_norm(tokens)), self.dropout, self.training)


class Transformer(nn.Module):
    """Transformer that predicts the action tokens and the terminate token of each frame.

    The input has, per frame, the image tokens of the cameras and 8 tokens of zeros. The outputs at the tokens of zeros
    are the predictions. Each token attends to the image tokens that precede it, and an image token also to itself. As
    in RT-1, no token attends to predicted tokens. Therefore one forward pass predicts all tokens.
    """

    mask: torch.Tensor

    def __init__(self, config: RT1Config) -> None:
        super().__init__()
        images = len(config.cameras) * config.image_tokens
        self.frames, self.images = config.frames, images
        self.input_projection = nn.Linear(config.token_width, config.width)
        self.position_embedding = nn.Parameter(
            torch.randn(config.frames * (images + FRAME_TOKENS), config.width) * 0.02
        )
        self.layers = nn.ModuleList([TransformerLayer(config) for _ in range(config.layers)])
        self.head = nn.Linear(config.width, config.bins)
        self.register_buffer("mask", make_attention_mask(config.frames, images, FRAME_TOKENS), persistent=False)

    def forward(self, image_tokens: torch.Tensor) -> torch.Tensor:
        """Return the logits (B, frames, 8, bins) of the action tokens and the terminate token.

        image_tokens: (B, frames, image tokens per frame, token_width).
        """
        projected = self.input_projection(image_tokens)
        empty = projected.new_zeros(len(projected), self.frames, FRAME_TOKENS, projected.shape[-1])
        tokens = torch.cat([projected, empty], dim=2).flatten(1, 2) + self.position_embedding
        for layer in self.layers:
            tokens = layer(tokens, self.mask)
        return self.head(tokens.unflatten(1, (self.frames, -1))[:, :, self.images :])


def make_attention_mask(frames: int, images: int, predicted: int) -> torch.Tensor:
    """Return the attention mask (L, L) bool: token i attends to token j if ``mask[i, j]``.

    frames: number of frames. images, predicted: number of image tokens and of predicted tokens per frame.
    """
    is_image = torch.arange(frames * (images + predicted)) % (images + predicted) < images
    return torch.ones(len(is_image), len(is_image), dtype=torch.bool).tril() & is_image


class RT1Model(nn.Module):
    """Network of RT-1: image encoders (`ImageEncoder`), `Transformer` and `ActionBins`."""

    mean: torch.Tensor
    std: torch.Tensor
    from_imagenet: torch.Tensor
    """() bool buffer: whether the image encoders were initialised from ``image_weights``; saved with the weights."""

    def __init__(self, config: RT1Config, facts: dict[str, Any]) -> None:
        super().__init__()
        self.config = config
        self.bins = ActionBins(facts["action_low"], facts["action_high"], config.bins)
        encoders = [ImageEncoder(config) for _ in config.cameras]
        self.encoders = nn.ModuleList(encoders)
        self.transformer = Transformer(config)
        for name, value in (("mean", config.image_mean), ("std", config.used_image_std)):
            self.register_buffer(name, 255 * torch.tensor(value).view(3, 1, 1), persistent=False)
        has_weights = config.image_weights is not None and config.image_weights.is_file()
        if config.image_weights is not None and has_weights:
            for encoder in encoders:
                encoder.load_efficientnet_weights(config.image_weights)
        self.register_buffer("from_imagenet", torch.tensor(has_weights))

    def encode(self, images: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return image tokens (N, cameras * image_tokens, token_width).

        Args:
            images: (N, cameras, 3, h, w) uint8.
            language: (N, 384) instruction embeddings.
        """
        scaled = (crop_rows(images, self.config.crop_height, random=self.training) - self.mean) / self.std
        return torch.cat([encoder(scaled[:, view], language) for view, encoder in enumerate(self.encoders)], dim=1)

    def logits(self, batch: Batch) -> torch.Tensor:
        """Return logits (B, frames, 8, bins) for a batch of `RT1Samples`."""
        images, language = batch["rgb"], batch["language"]
        frames = images.shape[1]
        tokens = self.encode(images.flatten(0, 1), language.repeat_interleave(frames, dim=0))
        return self.transformer(tokens.unflatten(0, (-1, frames))).float()

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Return the metrics of a batch of `RT1Samples`: ``loss`` (cross entropy), accuracies of tokens."""
        if self.training and self.config.image_weights is not None and not self.from_imagenet:
            raise TrainingError(
                "missing file of image_weights",
                where=f"image_weights {self.config.image_weights}",
                fix="Set image_weights to an existing file of EfficientNet's weights, or omit the option.",
            )
        logits, mask = self.logits(batch), batch["mask"]
        end = torch.where(batch["terminate"], TERMINATE, CONTINUE)
        labels = torch.cat([self.bins.encode(batch["action"]), end[..., None]], dim=-1)
        losses = F.cross_entropy(logits.flatten(0, 2), labels.flatten(), reduction="none").view_as(labels)
        with torch.no_grad():
            correct = (most_probable_tokens(logits) == labels).float()
        return {
            "loss": _masked_mean(losses, mask),
            "action_accuracy": _masked_mean(correct[..., :ACTION_TOKENS], mask),
            "gripper_accuracy": _masked_mean(correct[..., ACTION_TOKENS - 1 : ACTION_TOKENS], mask),
            "terminate_accuracy": _masked_mean(correct[..., ACTION_TOKENS:], mask),
        }

    def act(self, tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actions (B, 7) of the last frame, and whether each is the last of its episode (B,) bool.

        tokens: (B, frames, cameras * image_tokens, token_width), see `encode`.
        """
        predicted = most_probable_tokens(self.transformer(tokens)[:, -1].float())
        return self.bins.decode(predicted[:, :ACTION_TOKENS]), predicted[:, ACTION_TOKENS] == TERMINATE


def most_probable_tokens(logits: torch.Tensor) -> torch.Tensor:
    """Return the most probable action and terminate tokens (..., 8), from logits (..., 8, bins)."""
    action, end = logits[..., :ACTION_TOKENS, :], logits[..., ACTION_TOKENS:, : TERMINATE + 1]
    return torch.cat([action.argmax(-1), end.argmax(-1)], dim=-1)


def crop_rows(images: torch.Tensor, height: int, *, random: bool) -> torch.Tensor:
    """Return ``height`` rows of images (..., 3, h, w), float32: the middle rows, or random rows per image."""
    spare = images.shape[-2] - height
    if not random:
        first = spare // 2
        return images[..., first : first + height, :].float()
    flat = images.flatten(0, -4)
    start = torch.randint(0, spare + 1, (len(flat), 1), device=flat.device)
    rows = start + torch.arange(height, device=flat.device)  # (N, height)
    rows = rows[:, None, :, None].expand(-1, 3, -1, flat.shape[-1])
    return flat.gather(2, rows).view(*images.shape[:-2], height, -1).float()


def _masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return the mean () of values (B, frames, K) over the frames where ``mask`` (B, frames) is true."""
    return (values * mask[..., None]).sum() / (mask.sum() * values.shape[-1]).clamp(min=1)
