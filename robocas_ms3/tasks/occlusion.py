"""What lies on and around a target, as a camera above sees it: pure functions on batched tensors. N envs, K slots.

Objects are given as points on their surfaces, m. Each object's points are seen in a grid of square cells around the
target, which keeps the highest one of each cell; comparing these height maps says what hides what. The camera is the
one that p_vis is measured with (`scenes.visibility.top_down_camera`): it looks straight down, so that of the points on
a ray the highest is the nearest.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

CELL = 0.005  # edge of a cell, m, where the target is
CELLS = 64  # cells a side, so that what is seen within 0.16 m of the target's middle counts
NEAREST = 0.05  # m below the camera; what is higher counts as if it were there
MAX_HIDDEN_FRACTION = 0.2  # of a cleared target, the paper's
MAX_OBSTACLES = 1  # around it, the same
REACH = 2  # cells around the target's outline in which others count as neighbours: 1 cm
LEAST_MOTION = 1e-4  # m, and of a quaternion's components: less changes nothing that counts in cells of 5 mm
STAND_OFF = 0.02  # m between an obstacle and where its push begins

_OUTSIDE = CELLS * CELLS  # number of the cell that takes what lies in none
_NOTHING = -1e3  # height of an empty cell; finite, so that differences stay numbers


class Clutter(NamedTuple):
    """What is in the way of a target.

    Attributes:
        hidden_fraction: (N,) share of the target's outline that others cover, 1 - p_vis.
        obstacles: (N, K) bool, which others stick out above the target's mean height, visibly and within 1 cm of its
            outline.
    """

    hidden_fraction: Tensor
    obstacles: Tensor

    @property
    def cleared(self) -> Tensor:
        """(N,) bool, the paper's rule: at most a fifth is hidden, and fewer than two obstacles are left."""
        return (self.hidden_fraction <= MAX_HIDDEN_FRACTION) & (self.obstacles.sum(dim=1) <= MAX_OBSTACLES)


def surface_points(poses: Tensor, points: Tensor) -> Tensor:
    """Points fixed to objects, in the world.

    Args:
        poses: (N, K, 7) position and unit quaternion wxyz.
        points: (N, K, 3, P) in each object's frame, a column each.

    Returns:
        (N, K, 3, P).
    """
    w, x, y, z = poses[..., 3:].unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    rotation = torch.stack([entry for row in rows for entry in row], dim=-1).unflatten(-1, (3, 3))
    return rotation @ points + poses[..., :3, None]


def project_down(points: Tensor, eye: Tensor, depth: Tensor) -> Tensor:
    """Where points appear to a camera that looks straight down.

    Args:
        points: (N, K, 3, P) in the world, m.
        eye: (3,) the camera, world, m.
        depth: (N,) m below the camera, where sizes are to stay as they are.

    Returns:
        (N, K, 2, P) along the world's x and y, from right below the camera, m at ``depth``.
    """
    below = (eye[2] - points[:, :, 2]).clamp(min=NEAREST)
    return (points[:, :, :2] - eye[:2, None]) * (depth[:, None, None] / below)[:, :, None]


def has_moved_near(poses: Tensor, before: Tensor, radii: Tensor, target: Tensor, eye: Tensor) -> Tensor:
    """Return whether anything that `clutter` looks at has moved, the targets included.

    Args:
        poses: (N, K, 7) now.
        before: the same, then.
        radii: (N, K) of spheres about the objects' origins that hold them, m.
        target: (N,) slots of the targets.
        eye: (3,) the camera, world.

    Returns:
        (N,) bool.
    """
    env = torch.arange(len(target), device=poses.device)
    near = torch.zeros_like(radii, dtype=torch.bool)
    for at in (poses, before):
        aside, below = at[..., :2] - eye[:2], (eye[2] - at[..., 2]).clamp(min=NEAREST)
        above = (below - radii).clamp(min=NEAREST)  # where the camera would see the sphere farthest out
        seen = aside / below[..., None]
        size = (aside.abs() + radii[..., None]) / above[..., None] - seen.abs()
        # the target's outline, the cells around it, and one for where in its cell a point lies
        reach = size + size[env, target][:, None] + ((REACH + 1) * CELL / above[env, target])[:, None, None]
        near |= ((seen - seen[env, target][:, None]).abs() <= reach).all(dim=-1)
    return (((poses - before).abs() > LEAST_MOTION).any(dim=-1) & near).any(dim=-1)


def clutter(points: Tensor, present: Tensor, target: Tensor, eye: Tensor) -> Clutter:
    """Measure what hides and surrounds the targets.

    A cell of the target is hidden where another object's highest point is above the target's. Gaps of one cell between
    an object's points are closed.

    Args:
        points: (N, K, 3, P) on the objects' surfaces, world.
        present: (N, K) bool, slots that take part.
        target: (N,) slots of the targets.
        eye: (3,) the camera, world.
    """
    env = torch.arange(len(target), device=points.device)
    own = points[env, target]  # (N, 3, P)
    depth = (eye[2] - own[:, 2].mean(dim=-1)).clamp(min=NEAREST)
    seen = project_down(points, eye, depth)
    outline = seen[env, target]
    middle = (outline.amin(dim=-1) + outline.amax(dim=-1)) / 2
    cells, heights = _cells(seen, middle), points[:, :, 2]
    others = present.scatter(1, target[:, None], False)  # a number put at indices makes the host wait for a GPU
    others_cells = torch.where(others[..., None], cells, _OUTSIDE).flatten(1)
    top = _height_map(others_cells, heights.flatten(1))

    closed = _closed(torch.stack([_height_map(cells[env, target], own[:, 2]), top], dim=1))
    at_target, above_it = closed[:, 0], closed[:, 1] > closed[:, 0]
    filled = at_target > _NOTHING
    hidden_fraction = (filled & above_it).sum(dim=(1, 2)) / filled.sum(dim=(1, 2)).clamp(min=1)

    around = _widened(filled.float(), REACH) > 0
    sticks_out = around & (top > at_target) & (top > own[:, 2].mean(dim=-1)[:, None, None])
    # an object is an obstacle where one of its points is the highest of a cell that sticks out
    limit = torch.where(sticks_out, top, -_NOTHING).flatten(1)
    limit = pad(limit, (0, 1), value=-_NOTHING)
    highest = heights >= limit.gather(1, others_cells).view_as(heights)
    return Clutter(hidden_fraction, highest.any(dim=-1))


def pairwise_occlusion(points: Tensor, present: Tensor, eye: Tensor) -> Tensor:
    """How much of each object every other one would hide from the camera, if there were but these two.

    Args:
        points: (N, K, 3, P) on the objects' surfaces, world.
        present: (N, K) bool, slots that take part.
        eye: (3,) the camera, world.

    Returns:
        (N, K, K) share, by row of the object that covers, by column of the one that is covered.
    """
    count, slots = present.shape
    heights, shares = points[:, :, 2], []
    for slot in range(slots):
        own = points[:, slot]
        seen = project_down(points, eye, (eye[2] - own[:, 2].mean(dim=-1)).clamp(min=NEAREST))
        outline = seen[:, slot]
        cells = _cells(seen, (outline.amin(dim=-1) + outline.amax(dim=-1)) / 2)
        maps = _closed(_height_map(cells.flatten(0, 1), heights.flatten(0, 1)).unflatten(0, (count, slots)))
        at_it = maps[:, slot : slot + 1]
        filled = at_it > _NOTHING
        shares.append((filled & (maps > at_it)).sum(dim=(2, 3)) / filled.sum(dim=(2, 3)).clamp(min=1))
    both = present[:, :, None] & present[:, None]
    return torch.stack(shares, dim=2) * both


def push_point(points: Tensor, obstacles: Tensor, target: Tensor) -> Tensor:
    """Where the paper's push of the highest obstacle begins: clear of it, on the target's side, level with its middle.

    Args:
        points: (N, K, 3, P) on the objects' surfaces, world.
        obstacles: (N, K) bool, see `Clutter`; where there are none, the target's own middle is given.
        target: (N,) slots of the targets.

    Returns:
        (N, 3) world.
    """
    env = torch.arange(len(target), device=points.device)
    tops = points[:, :, 2].amax(dim=-1).masked_fill(~obstacles, -torch.inf)
    highest, goal = points[env, tops.argmax(dim=1)], points[env, target].mean(dim=-1)
    middle = highest.mean(dim=-1)
    away = (middle - goal)[:, :2]
    away = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp(min=1e-6)
    behind = ((highest - middle[..., None])[:, :2] * away[..., None]).sum(dim=1).amin(dim=-1)  # (N,), negative
    beside = torch.cat([middle[:, :2] + (behind - STAND_OFF)[:, None] * away, middle[:, 2:]], dim=-1)
    return torch.where(obstacles.any(dim=1)[:, None], beside, goal)


def _cells(points: Tensor, middle: Tensor) -> Tensor:
    """Number of the cell around ``middle`` (N, 2) that each of points (N, K, 2, P) lies in, (N, K, P)."""
    cell = torch.floor((points - middle[:, None, :, None]) / CELL).long() + CELLS // 2
    inside = (cell >= 0) & (cell < CELLS)
    return torch.where(inside[:, :, 0] & inside[:, :, 1], cell[:, :, 0] * CELLS + cell[:, :, 1], _OUTSIDE)


def _height_map(cells: Tensor, heights: Tensor) -> Tensor:
    """Highest of points (N, P) in each cell, (N, CELLS, CELLS); ``_NOTHING``: none."""
    empty = torch.full((len(cells), _OUTSIDE + 1), _NOTHING, device=cells.device)
    return empty.scatter_reduce(1, cells, heights, "amax")[:, :_OUTSIDE].unflatten(1, (CELLS, CELLS))


def _closed(maps: Tensor) -> Tensor:
    """Close the holes that sampling leaves in height maps (N, M, CELLS, CELLS): dilated, then eroded."""
    return -_widened(-_widened(maps, 1), 1)


def _widened(maps: Tensor, reach: int) -> Tensor:
    """Greatest value within ``reach`` cells, along and across; on a CPU faster than `max_pool2d` by far."""
    across = pad(maps, (reach, reach), value=-torch.inf).unfold(-1, 2 * reach + 1, 1).amax(dim=-1)
    return pad(across, (0, 0, reach, reach), value=-torch.inf).unfold(-2, 2 * reach + 1, 1).amax(dim=-1)
