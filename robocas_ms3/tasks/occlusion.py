"""What lies on and around a target, seen from above: pure functions on batched tensors. N envs, K slots; metres.

Objects are given as points on their surfaces. Each object's points are dropped into a grid of square cells around the
target, which keeps the highest one of each cell; comparing these height maps says what hides what.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

CELL = 0.005  # edge of a cell, m
CELLS = 64  # cells a side, so that what is within 0.16 m of the target's middle counts
MAX_HIDDEN_SHARE = 0.2  # of a cleared target, the paper's
REACH = 2  # cells around the target's outline in which others count as neighbours: 1 cm

_NOTHING = -1e3  # height of an empty cell; finite, so that differences stay numbers


class Clutter(NamedTuple):
    """What is in the way of a target.

    Attributes:
        hidden_share: (N,) share of the target's outline from above that others cover, 1 - p_vis.
        obstacles: (N, K) bool, which others stick out above the target's mean height, visibly and within 1 cm of its
            outline.
    """

    hidden_share: Tensor
    obstacles: Tensor

    @property
    def cleared(self) -> Tensor:
        """(N,) bool, the paper's rule: at most a fifth is hidden, and fewer than two obstacles are left."""
        return (self.hidden_share <= MAX_HIDDEN_SHARE) & (self.obstacles.sum(dim=1) < 2)


def surface_points(poses: Tensor, points: Tensor) -> Tensor:
    """Points fixed to objects, in the world.

    Args:
        poses: (N, K, 7) position and unit quaternion wxyz.
        points: (N, K, P, 3) in each object's frame.

    Returns:
        (N, K, P, 3).
    """
    w, x, y, z = poses[..., 3:].unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    rotation = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return points @ rotation.transpose(-1, -2) + poses[..., None, :3]


def clutter(points: Tensor, present: Tensor, target: Tensor) -> Clutter:
    """Measure what hides and surrounds the targets.

    A cell of the target is hidden where another object's highest point is above the target's. Gaps of one cell between
    an object's points are closed.

    Args:
        points: (N, K, P, 3) on the objects' surfaces, world.
        present: (N, K) bool, slots that take part.
        target: (N,) slots of the targets.
    """
    env = torch.arange(len(target), device=points.device)
    own = points[env, target]  # (N, P, 3)
    low, high = own[..., :2].amin(dim=1), own[..., :2].amax(dim=1)
    heights = _height_maps(points, (low + high) / 2)
    others = present.clone()
    others[env, target] = False
    top, who = torch.where(others[..., None, None], heights, _NOTHING).max(dim=1)

    closed = _closed(torch.stack([heights[env, target], top], dim=1))
    at_target, above_it = closed[:, 0], closed[:, 1] > closed[:, 0]
    outline = at_target > _NOTHING
    hidden_share = (outline & above_it).sum(dim=(1, 2)) / outline.sum(dim=(1, 2)).clamp(min=1)

    around = max_pool2d(outline.float(), 2 * REACH + 1, stride=1, padding=REACH) > 0
    sticks_out = around & (top > at_target) & (top > own[..., 2].mean(dim=1)[:, None, None])
    cells = torch.zeros(present.shape, device=points.device)
    cells.scatter_add_(1, who.flatten(1), sticks_out.flatten(1).float())
    return Clutter(hidden_share, cells > 0)


def _height_maps(points: Tensor, center: Tensor) -> Tensor:
    """Highest point of each object in each cell (N, K, CELLS, CELLS) around centers (N, 2); ``_NOTHING``: none."""
    envs, slots = points.shape[:2]
    cell = torch.floor((points[..., :2] - center[:, None, None]) / CELL).long() + CELLS // 2
    inside = ((cell >= 0) & (cell < CELLS)).all(dim=-1)
    index = torch.where(inside, cell[..., 0] * CELLS + cell[..., 1], 0)
    height = torch.where(inside, points[..., 2], _NOTHING)
    maps = torch.full((envs, slots, CELLS * CELLS), _NOTHING, device=points.device)
    return maps.scatter_reduce(2, index, height, "amax").view(envs, slots, CELLS, CELLS)


def _closed(maps: Tensor) -> Tensor:
    """Close the holes that sampling leaves in height maps (N, M, CELLS, CELLS): dilated, then eroded."""
    grown = max_pool2d(maps, 3, stride=1, padding=1)
    return -max_pool2d(-grown, 3, stride=1, padding=1)
