"""Where in a picture things are that language names: labels, and what finds them.

Demonstrations say it twice. Where the TCP is when the gripper's command changes next is what the instruction leads to
now; and until the gripper closes, each object stands where the layout put it, so that a picture answers for all of
them, by the words of other episodes. To find the object that is meant is what a chunk's error hardly rewards until
the hand is there.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from robocas_ms3.baselines.small.config import View
from robocas_ms3.core.poses import Array, inverse, transform

CELL = 8
"""Pixels a side of what is told apart."""
NOWHERE = -1
"""Cell of what is not in the picture."""
_NEAREST = 0.01  # m before the camera


def places_of(
    points: NDArray[np.floating], camera: Array, intrinsic: Array, stored: tuple[int, int], view: View
) -> NDArray[np.float32]:
    """(..., 2) x and y in pixels of a view at which points are seen, in or out of it; NaN: behind the camera.

    Args:
        points: (..., 3) in the camera's parent, m.
        camera: (4, 4) OpenCV camera frame in that parent.
        intrinsic: (4,) fx, fy, cx, cy of the stored pictures, in pixels.
        stored: width and height of those.
        view: what is looked at of them.
    """
    seen = transform(inverse(camera), np.asarray(points, np.float64))
    depth = np.maximum(seen[..., 2:], _NEAREST)
    share = (seen[..., :2] / depth * intrinsic[:2] + intrinsic[2:]) / np.array(stored)
    left, top, right, bottom = np.array(view.box()) / np.tile(view.rendered, 2)
    inside = (share - (left, top)) / (right - left, bottom - top)
    return np.where(seen[..., 2:] > _NEAREST, inside * view.size, np.nan).astype(np.float32)


def cells_of(places: torch.Tensor, view: View) -> torch.Tensor:
    """(...) cells of a view, row by row, in which places (..., 2) lie; `NOWHERE`: in none."""
    size = torch.tensor(view.size, device=places.device)
    inside = ((places >= 0) & (places < size)).all(dim=-1)  # NaN is not
    cell = (places.nan_to_num(0.0) / CELL).floor().long()
    return torch.where(inside, cell[..., 1] * (view.size[0] // CELL) + cell[..., 0], NOWHERE)


class Pointer(nn.Module):
    """Compares each cell of a feature map with what is looked for, and tells what is there, and where.

    Args:
        view: that the map is of.
        channels: of the map.
        width: of what is looked for, and of what is told.
        tells: whether it is asked for more than `logits`.
    """

    places: torch.Tensor

    def __init__(self, view: View, channels: int, width: int, *, tells: bool = True) -> None:
        super().__init__()
        columns, rows = view.size[0] // CELL, view.size[1] // CELL
        y, x = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
        self.register_buffer("places", torch.stack([x, y], dim=-1).reshape(-1, 2), persistent=False)
        self.wanted = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, channels))
        self.offered = nn.Conv2d(channels, channels, 1)
        if tells:
            self.tell = nn.Linear(channels + 2, width)

    def logits(self, seen: torch.Tensor, asked: torch.Tensor) -> torch.Tensor:
        """(B, Q, h w) of the cells, of maps (B, C, h, w) and questions (B, Q, width)."""
        offered = self.offered(seen).flatten(2)
        return torch.einsum("bqc,bcn->bqn", self.wanted(asked), offered).float() / math.sqrt(offered.shape[1])

    def forward(self, seen: torch.Tensor, asked: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What is pointed at (B, width), and logits of the cells (B, h w), of maps (B, C, h, w) and (B, width)."""
        logits = self.logits(seen, asked[:, None])[:, 0]
        share = logits.softmax(dim=1)
        what = torch.einsum("bn,bcn->bc", share, seen.flatten(2).float())
        return self.tell(torch.cat([what, share @ self.places], dim=1)), logits


def pointing_losses(logits: torch.Tensor, cells: torch.Tensor, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Cross entropy of the cells, and how many were found to one cell.

    Args:
        logits: (..., N).
        cells: (..., I) each of which is a right answer; `NOWHERE` where it is not in the picture.
        columns: of the cells.

    Returns:
        Two (2,): a sum over the questions with an answer in the picture, and how many these are.
    """
    shown = cells != NOWHERE
    asked = shown.any(dim=-1)
    count = asked.sum()
    share = logits.log_softmax(dim=-1).gather(-1, cells.clamp(min=0)).masked_fill(~shown, -torch.inf)
    right = torch.where(asked[..., None], share, 0.0).logsumexp(dim=-1)  # of one or the other
    loss = -(right * asked).sum()
    with torch.no_grad():
        found = logits.argmax(dim=-1, keepdim=True)
        off = torch.maximum(
            (found % columns - cells % columns).abs(),
            (found // columns - cells // columns).abs(),
        )
        close = ((off <= 1) & shown).any(dim=-1).sum()
    return torch.stack([loss, count]), torch.stack([close, count])
