"""Where in a picture the gripper will close or open next: labels for it, and what finds it.

Demonstrations say it: where the TCP is when the gripper's command changes, seen through a calibrated camera. To find
that place in a picture is to tell the object that is meant from the others, which a chunk's error hardly rewards until
the hand is there.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.small.config import View
from robocas_ms3.poses import Array, inverse, transform

CELL = 8
"""Pixels a side of what is told apart."""
NOWHERE = -1
"""Cell of what is not in the picture."""
_NEAREST = 0.01  # m before the camera


def cells_of(
    points: NDArray[np.floating], camera: Array, intrinsic: Array, stored: tuple[int, int], view: View
) -> NDArray[np.int64]:
    """(N,) cells of a view, row by row, in which points lie; `NOWHERE`: in none.

    Args:
        points: (N, 3) in the camera's parent, m.
        camera: (4, 4) OpenCV camera frame in that parent.
        intrinsic: (4,) fx, fy, cx, cy of the stored pictures, in pixels.
        stored: width and height of those.
        view: what is looked at of them.
    """
    seen = transform(inverse(camera), np.asarray(points, np.float64))
    depth = np.maximum(seen[:, 2], _NEAREST)
    share = (seen[:, :2] / depth[:, None] * intrinsic[:2] + intrinsic[2:]) / np.array(stored)
    left, top, right, bottom = np.array(view.box()) / np.tile(view.rendered, 2)
    inside = (share - (left, top)) / (right - left, bottom - top)
    columns, rows = view.size[0] // CELL, view.size[1] // CELL
    cell = np.floor(inside * (columns, rows)).clip(-1e6, 1e6).astype(np.int64)
    there = (inside >= 0).all(1) & (inside < 1).all(1) & (seen[:, 2] > _NEAREST)
    return np.where(there, cell[:, 1] * columns + cell[:, 0], NOWHERE)


class Pointer(nn.Module):
    """Compares each cell of a feature map with what is looked for, and tells what is there, and where.

    Args:
        view: that the map is of.
        channels: of the map.
        width: of what is looked for, and of what is told.
    """

    places: torch.Tensor

    def __init__(self, view: View, channels: int, width: int) -> None:
        super().__init__()
        columns, rows = view.size[0] // CELL, view.size[1] // CELL
        y, x = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
        self.register_buffer("places", torch.stack([x, y], dim=-1).reshape(-1, 2), persistent=False)
        self.wanted, self.offered = nn.Linear(width, channels), nn.Conv2d(channels, channels, 1)
        self.tell = nn.Linear(channels + 2, width)

    def forward(self, seen: torch.Tensor, asked: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What is pointed at (B, width), and logits of the cells (B, h w), of maps (B, C, h, w) and (B, width)."""
        offered = self.offered(seen).flatten(2)
        wanted = self.wanted(asked)
        logits = torch.einsum("bc,bcn->bn", wanted, offered).float() / math.sqrt(offered.shape[1])
        share = logits.softmax(dim=1)
        what = torch.einsum("bn,bcn->bc", share, seen.flatten(2).float())
        return self.tell(torch.cat([what, share @ self.places], dim=1)), logits


def pointing_losses(logits: torch.Tensor, cells: torch.Tensor, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Cross entropy of the cells, and the share found to one cell; of pictures that show the place.

    Args:
        logits: (B, N).
        cells: (B,), `NOWHERE` where it is not in the picture.
        columns: of the cells.
    """
    shown = cells != NOWHERE
    count = shown.sum().clamp(min=1)
    loss = F.cross_entropy(logits, cells, ignore_index=NOWHERE, reduction="sum") / count
    with torch.no_grad():
        found = logits.argmax(dim=1)
        off = torch.maximum(
            (found % columns - cells % columns).abs(),
            (found // columns - cells // columns).abs(),
        )
        return loss, ((off <= 1) & shown).sum() / count
