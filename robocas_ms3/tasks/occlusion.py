"""Measure which objects hide a target, and which objects are obstacles next to it.

The view is from above. N envs, K object slots.

Each object is given by points on its surface. They are projected to a grid of square cells around the target. A height
map has the highest point of each cell. The height maps of two objects show which of them hides the other. The camera is
that of the visible fraction (`scenes.visibility.top_down_camera`). It looks straight down, so the highest point in a
cell is the nearest to the camera.

An *obstacle* is an object that sticks out above the target's mean height within 1 cm of its outline (`Clutter`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from robocas_ms3.scenes.task_specs import MAX_HIDDEN_FRACTION, MAX_OBSTACLES

POINTS = 512
"""Points per object. Hidden fractions differ from ray casting by 0.03 on average, 0.08 at the 95th percentile."""
CELL = 0.005  # edge of a cell at the target's depth, m
CELLS = 64  # cells per side: the grid extends 0.16 m from the target's middle
NEAREST = 0.05  # m below the camera; points that are higher are treated as if they were at this depth
REACH = 2  # cells (1 cm) around the target's outline in which an object can be an obstacle
LEAST_MOTION = 1e-4  # m and quaternion components; less motion has no effect in cells of 5 mm
PUSH_START_DISTANCE = 0.02  # m between an obstacle and the point where its push starts

_OUTSIDE = CELLS * CELLS  # index of the cell for points outside of the grid
_NOTHING = -1e3  # height of an empty cell; finite, so that differences are finite


class Clutter(NamedTuple):
    """Clutter around the target of each env, seen from above.

    Attributes:
        hidden_fraction: (N,) fraction of the target's outline that other objects cover: 1 - p_vis of the paper.
        obstacles: (N, K) bool, whether each object is an obstacle: visible from above, above the target's mean height,
            and within 1 cm of the target's outline.
    """

    hidden_fraction: Tensor
    obstacles: Tensor

    @property
    def is_target_cleared(self) -> Tensor:
        """(N,) bool, the paper's rule of a cleared target: at most 20 % hidden, and at most one obstacle."""
        return (self.hidden_fraction <= MAX_HIDDEN_FRACTION) & (self.obstacles.sum(dim=1) <= MAX_OBSTACLES)


def sample_points(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return `POINTS` evenly spaced rows of points (P, 3); rows repeat if P is smaller."""
    return points[np.linspace(0, len(points) - 1, POINTS).round().astype(int)]


def surface_points_in_world(poses: Tensor, points: Tensor) -> Tensor:
    """Transform surface points of objects to the world frame.

    Args:
        poses: (N, K, 7) world poses of the objects: position m, unit quaternion wxyz.
        points: (N, K, 3, P) P points per object in the object's frame, m.

    Returns:
        (N, K, 3, P) points in the world frame, m.
    """
    w, x, y, z = poses[..., 3:].unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    rotation = torch.stack([entry for row in rows for entry in row], dim=-1).unflatten(-1, (3, 3))
    return rotation @ points + poses[..., :3, None]


def project_to_horizontal_plane(points: Tensor, eye: Tensor, depth: Tensor) -> Tensor:
    """Project points to a horizontal plane, as seen by a camera that looks straight down.

    Args:
        points: (N, K, 3, P) points in the world frame, m.
        eye: (3,) position of the camera in the world frame, m.
        depth: (N,) distance of the plane below the camera, m.

    Returns:
        (N, K, 2, P) x and y of the projected points, along the world's axes and relative to the camera, m.
    """
    below = (eye[2] - points[:, :, 2]).clamp(min=NEAREST)
    return (points[:, :, :2] - eye[:2, None]) * (depth[:, None, None] / below)[:, :, None]


def has_clutter_moved(poses: Tensor, earlier_poses: Tensor, radii: Tensor, target_slot: Tensor, eye: Tensor) -> Tensor:
    """Return (N,) bool, whether the target or an object near it has moved.

    If not, the clutter around the target is unchanged.

    Args:
        poses: (N, K, 7) current world poses of the objects.
        earlier_poses: (N, K, 7) their poses at the last measurement.
        radii: (N, K) radii of bounding spheres about the objects' origins, m.
        target_slot: (N,) slot of each target.
        eye: (3,) position of the camera in the world frame, m.
    """
    env = torch.arange(len(target_slot), device=poses.device)
    near = torch.zeros_like(radii, dtype=torch.bool)
    for at in (poses, earlier_poses):
        aside, below = at[..., :2] - eye[:2], (eye[2] - at[..., 2]).clamp(min=NEAREST)
        above = (below - radii).clamp(min=NEAREST)  # depth at which the sphere appears largest
        seen = aside / below[..., None]
        size = (aside.abs() + radii[..., None]) / above[..., None] - seen.abs()
        # the target's outline, the cells around it, and one cell for rounding
        reach = size + size[env, target_slot][:, None] + ((REACH + 1) * CELL / above[env, target_slot])[:, None, None]
        near |= ((seen - seen[env, target_slot][:, None]).abs() <= reach).all(dim=-1)
    return (((poses - earlier_poses).abs() > LEAST_MOTION).any(dim=-1) & near).any(dim=-1)


def measure_clutter(points: Tensor, present: Tensor, target_slot: Tensor, eye: Tensor) -> Clutter:
    """Measure the hidden fraction of each target, and find the obstacles around it.

    A cell of the target is hidden if another object has a higher point in this cell. Gaps of one cell between the
    points of an object are closed first.

    Args:
        points: (N, K, 3, P) points on the objects' surfaces, world frame, m.
        present: (N, K) bool, whether each slot has an object.
        target_slot: (N,) slot of each target.
        eye: (3,) position of the camera in the world frame, m.
    """
    env = torch.arange(len(target_slot), device=points.device)
    own = points[env, target_slot]  # (N, 3, P)
    depth = (eye[2] - own[:, 2].mean(dim=-1)).clamp(min=NEAREST)
    seen = project_to_horizontal_plane(points, eye, depth)
    outline = seen[env, target_slot]
    middle = (outline.amin(dim=-1) + outline.amax(dim=-1)) / 2
    cells, heights = _cell_indices(seen, middle), points[:, :, 2]
    others = present.scatter(1, target_slot[:, None], False)  # assigning by index would synchronise with a GPU
    others_cells = torch.where(others[..., None], cells, _OUTSIDE).flatten(1)
    top = _height_map(others_cells, heights.flatten(1))

    closed = _close_gaps(torch.stack([_height_map(cells[env, target_slot], own[:, 2]), top], dim=1))
    at_target, above_it = closed[:, 0], closed[:, 1] > closed[:, 0]
    filled = at_target > _NOTHING
    hidden_fraction = (filled & above_it).sum(dim=(1, 2)) / filled.sum(dim=(1, 2)).clamp(min=1)

    around = _dilate(filled.float(), REACH) > 0
    sticks_out = around & (top > at_target) & (top > own[:, 2].mean(dim=-1)[:, None, None])
    # an object is an obstacle if one of its points is the highest of a cell that sticks out
    limit = torch.where(sticks_out, top, -_NOTHING).flatten(1)
    limit = pad(limit, (0, 1), value=-_NOTHING)
    highest = heights >= limit.gather(1, others_cells).view_as(heights)
    return Clutter(hidden_fraction, highest.any(dim=-1))


def measure_pairwise_occlusion(points: Tensor, present: Tensor, eye: Tensor) -> Tensor:
    """Return the fraction of each object that each other object hides on its own, seen from above.

    Args:
        points: (N, K, 3, P) points on the objects' surfaces, world frame, m.
        present: (N, K) bool, whether each slot has an object.
        eye: (3,) position of the camera in the world frame, m.

    Returns:
        (N, K, K) fractions; entry [n, i, j] is the fraction of object j that object i hides.
    """
    count, slots = present.shape
    heights, fractions = points[:, :, 2], []
    for slot in range(slots):
        own = points[:, slot]
        seen = project_to_horizontal_plane(points, eye, (eye[2] - own[:, 2].mean(dim=-1)).clamp(min=NEAREST))
        outline = seen[:, slot]
        cells = _cell_indices(seen, (outline.amin(dim=-1) + outline.amax(dim=-1)) / 2)
        maps = _close_gaps(_height_map(cells.flatten(0, 1), heights.flatten(0, 1)).unflatten(0, (count, slots)))
        at_it = maps[:, slot : slot + 1]
        filled = at_it > _NOTHING
        fractions.append((filled & (maps > at_it)).sum(dim=(2, 3)) / filled.sum(dim=(2, 3)).clamp(min=1))
    both = present[:, :, None] & present[:, None]
    return torch.stack(fractions, dim=2) * both


def find_push_point(points: Tensor, obstacles: Tensor, target_slot: Tensor) -> Tensor:
    """Return the point where the paper's push of the highest obstacle starts.

    It is 2 cm from the obstacle, on the target's side.

    Args:
        points: (N, K, 3, P) points on the objects' surfaces, world frame, m.
        obstacles: (N, K) bool, whether each object is an obstacle (`Clutter`).
        target_slot: (N,) slot of each target.

    Returns:
        (N, 3) points in the world frame, m; the middle of the target in envs without obstacles.
    """
    env = torch.arange(len(target_slot), device=points.device)
    tops = points[:, :, 2].amax(dim=-1).masked_fill(~obstacles, -torch.inf)
    highest, goal = points[env, tops.argmax(dim=1)], points[env, target_slot].mean(dim=-1)
    middle = highest.mean(dim=-1)
    away = (middle - goal)[:, :2]
    away = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp(min=1e-6)
    behind = ((highest - middle[..., None])[:, :2] * away[..., None]).sum(dim=1).amin(dim=-1)  # (N,), negative
    beside = torch.cat([middle[:, :2] + (behind - PUSH_START_DISTANCE)[:, None] * away, middle[:, 2:]], dim=-1)
    return torch.where(obstacles.any(dim=1)[:, None], beside, goal)


def _cell_indices(points: Tensor, middle: Tensor) -> Tensor:
    """Return the cell index (N, K, P) of each point (N, K, 2, P) in the grid around ``middle`` (N, 2)."""
    cell = torch.floor((points - middle[:, None, :, None]) / CELL).long() + CELLS // 2
    inside = (cell >= 0) & (cell < CELLS)
    return torch.where(inside[:, :, 0] & inside[:, :, 1], cell[:, :, 0] * CELLS + cell[:, :, 1], _OUTSIDE)


def _height_map(cells: Tensor, heights: Tensor) -> Tensor:
    """Return height maps (N, CELLS, CELLS) from cell indices (N, P) and heights (N, P).

    An empty cell has the height ``_NOTHING``.
    """
    empty = torch.full((len(cells), _OUTSIDE + 1), _NOTHING, device=cells.device)
    return empty.scatter_reduce(1, cells, heights, "amax")[:, :_OUTSIDE].unflatten(1, (CELLS, CELLS))


def _close_gaps(maps: Tensor) -> Tensor:
    """Fill gaps between the sampled points in height maps (N, M, CELLS, CELLS): dilate, then erode."""
    return -_dilate(-_dilate(maps, 1), 1)


def _dilate(maps: Tensor, reach: int) -> Tensor:
    """Dilate height maps (..., CELLS, CELLS) by ``reach`` cells; on a CPU much faster than `max_pool2d`."""
    across = pad(maps, (reach, reach), value=-torch.inf).unfold(-1, 2 * reach + 1, 1).amax(dim=-1)
    return pad(across, (0, 0, reach, reach), value=-torch.inf).unfold(-2, 2 * reach + 1, 1).amax(dim=-1)
