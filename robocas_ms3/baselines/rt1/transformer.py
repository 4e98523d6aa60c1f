"""RT-1's transformer: it reads the tokens of some frames, and says an action beside each."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.tokens import FRAME_TOKENS


class Layer(nn.Module):
    """Attention, then a linear map, each beside what comes in; RT-1's feed-forward layer is this one map."""

    def __init__(self, config: RT1Config) -> None:
        super().__init__()
        inner = config.heads * config.key_width
        self.heads, self.dropout = config.heads, config.dropout
        self.norm, self.feed_norm = nn.LayerNorm(config.width, eps=1e-6), nn.LayerNorm(config.width, eps=1e-6)
        self.ask, self.answer = nn.Linear(config.width, 3 * inner), nn.Linear(inner, config.width)
        self.feed = nn.Linear(config.width, config.width)

    def forward(self, tokens: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        """(B, L, width) of the same; ``seen`` (L, L) says which row looks at which column."""
        asked = self.ask(self.norm(tokens)).unflatten(-1, (3, self.heads, -1))
        query, key, value = asked.permute(2, 0, 3, 1, 4)  # (B, heads, L, key width) each
        dropout = self.dropout if self.training else 0.0
        found = F.scaled_dot_product_attention(query, key, value, attn_mask=seen, dropout_p=dropout)
        tokens = tokens + self.answer(found.transpose(1, 2).flatten(2))
        return tokens + F.dropout(self.feed(self.feed_norm(tokens)), self.dropout, self.training)


class Transformer(nn.Module):
    """Logits of the tokens of an action, beside each frame.

    A frame is the image tokens of its cameras and a place for each token it is to say. A token looks at image tokens
    that come before it, and at itself if it is one; as in RT-1, what was said before is not looked at, so all is said
    at once.
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
        self.register_buffer("seen", looked_at(config.frames, images, FRAME_TOKENS), persistent=False)

    def forward(self, image_tokens: torch.Tensor) -> torch.Tensor:
        """(B, frames, 8, bins) of image tokens (B, frames, images, token_width)."""
        entered = self.enter(image_tokens)
        empty = entered.new_zeros(len(entered), self.frames, FRAME_TOKENS, entered.shape[-1])
        tokens = torch.cat([entered, empty], dim=2).flatten(1, 2) + self.places
        for layer in self.layers:
            tokens = layer(tokens, self.seen)
        said = tokens.unflatten(1, (self.frames, -1))[:, :, self.images :]
        return self.leave(said)


def looked_at(frames: int, images: int, said: int) -> torch.Tensor:
    """(L, L) bool: which of a sequence's tokens (row) looks at which (column)."""
    is_image = torch.arange(frames * (images + said)) % (images + said) < images
    return torch.ones(len(is_image), len(is_image), dtype=torch.bool).tril() & is_image
