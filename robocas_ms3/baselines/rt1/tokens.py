"""Actions as tokens: seven numbers, each in one of so many bins over its range."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

GO_ON, OVER = 0, 1
"""Tokens of whether an episode ends; they are told by the first two of the bins' logits, as in RT-1."""
ACTION_TOKENS = 7
FRAME_TOKENS = ACTION_TOKENS + 1
"""Seven numbers of an action, and whether the episode ends."""


class ActionBins(nn.Module):
    """Bins of equal width over the ranges of the motion; over 0..1 for the gripper.

    What is beyond a range falls into its first or last bin; an axis without a range has but one value.

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
        """(..., 7) int64 tokens of actions (..., 7)."""
        share = (actions - self.low) / torch.where(self.span > 0, self.span, 1.0)
        return (share * self.bins).floor().clamp(0, self.bins - 1).long()

    def decode(self, tokens: torch.Tensor) -> torch.Tensor:
        """(..., 7) actions: the middles of the bins."""
        return self.low + (tokens + 0.5) / self.bins * self.span
