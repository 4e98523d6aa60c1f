"""Which pushes of an object there are: geometry only, no simulator. Everything is in the arm's base frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.protocol import Array

STAND_OFF = 0.02  # m between the tool and the object before the push (upstream's)
TOOL_RADIUS = 0.012  # m, half the width of the closed fingers
TIP_BELOW_TCP = 0.0085  # m, by which the pads reach beyond the TCP
TIP_CLEARANCE = 0.012  # m kept between the finger tips and the surface
BELOW_TOP = 0.02  # m; nearer to an object's top the tool would slide over it
PUSH_BEYOND_CENTER = (
    0.1  # m that the tool goes past where the object's middle was (upstream's; the paper: 2 d_ext in all)
)
EDGE_MARGIN = 0.08  # m that a pushed object keeps from the surface's edge
WALL_MARGIN = 0.02  # m that it keeps from furniture and basket
PUSHED_THINNED = 5  # every fifth point of an object will do for that: they are 5 mm apart
COINCIDENT_DISTANCE = (
    0.01  # m; an object whose centre is closer than this to the target's has no direction of its own (upstream's)
)
TURNS_DEG = (0.0, 20.0, -20.0, 40.0, -40.0, 65.0, -65.0, 90.0, -90.0)  # directions tried, off the paper's one
YAWS = 4  # turns of the tool about the vertical, of half a turn


@dataclass(frozen=True)
class Push:
    """A push to try: the TCP's start (4x4), its direction (3,), level and of length 1, and the length of its way, m."""

    start: Array
    direction: Array
    length: float

    @property
    def end(self) -> Array:
        pose = self.start.copy()
        pose[:3, 3] += self.length * self.direction
        return pose


def push_candidates(
    rng: np.random.Generator,
    points: Array,
    target: Array,
    others: Array,
    surface: tuple[Array, Array],
    fixed: Array,
    turn_deg: float = 0.0,
) -> Iterator[Push]:
    """Yield pushes of an object that begin clear of all else and end on the surface; the paper's direction first.

    The object may be pushed against other objects, but neither over the edge nor against furniture or basket. The tool
    touches at the target's height, or at the nearest height above it at which there is room for it.

    Args:
        points: (P, 3) surface of the object, upright frame, m.
        target: (3,) middle of the target.
        others: (Q, 3) surfaces of everything else.
        surface: of `surface_in_base`.
        fixed: (R, 3) surfaces of furniture and basket.
        turn_deg: by which the paper's direction is turned.
    """
    frame, half = surface
    walls = fixed[(fixed[:, 2] > frame[2, 3] + 0.01) & (fixed[:, 2] < points[:, 2].max())][:, :2]
    tree = KDTree(walls) if len(walls) else None
    center = points.mean(axis=0)
    ahead = push_direction(rng, center, target)
    ahead = Rotation.from_euler("z", turn_deg, degrees=True).apply(ahead)
    lowest = frame[2, 3] + TIP_CLEARANCE + TIP_BELOW_TCP
    top = points[:, 2].max()
    heights = np.arange(max(target[2], points[:, 2].min(), lowest), top - BELOW_TOP, 0.015).tolist()
    if not heights and top - 0.01 >= lowest:
        heights = [top - 0.01]
    near = others[np.linalg.norm(others[:, :2] - center[:2], axis=1) < 0.3]
    for turn in TURNS_DEG:
        direction = Rotation.from_euler("z", turn, degrees=True).apply(ahead)
        for height in heights:
            extent = extent_behind(points, center, direction, height)
            if extent is None:
                continue
            tool = np.array([*center[:2], height]) - (extent + STAND_OFF + TOOL_RADIUS) * direction
            if not _tool_fits(tool, near):
                continue
            length = STAND_OFF + extent + PUSH_BEYOND_CENTER
            shift = (length - STAND_OFF) * direction
            if not _ends_on(points + shift, frame, half) or _hits(tree, points, shift):
                continue
            yaw = np.arctan2(direction[1], direction[0])
            for k in range(YAWS):
                start = np.eye(4)
                start[:3, :3] = (Rotation.from_euler("z", yaw + k * np.pi / YAWS) * _DOWN).as_matrix()
                start[:3, 3] = tool
                yield Push(start, direction, length)
            break  # higher up it would tip rather than slide


_DOWN = Rotation.from_euler("x", np.pi)


def push_direction(rng: np.random.Generator, center: Array, target: Array) -> Array:
    """Return the paper's v_push: (3,) level unit vector from the target to the obstacle.

    Where they are less than 1 cm apart: within 30 deg of towards the robot, which stands at the origin.
    """
    away = np.append((center - target)[:2], 0.0)
    if np.linalg.norm(away) < COINCIDENT_DISTANCE:
        home = np.append(-center[:2], 0.0)
        away = Rotation.from_euler("z", rng.uniform(-30, 30), degrees=True).apply(home)
    return away / np.linalg.norm(away)


def extent_behind(points: Array, center: Array, direction: Array, height: float) -> float | None:
    """Return the paper's d_ext: how far an object reaches from its middle against the push at a height, or None.

    Only what the tool would meet counts: points within its width of the line, 1 cm above or below the height.
    """
    relative = points - center
    across = np.abs(relative[:, :2] @ np.array([-direction[1], direction[0]]))
    slice_ = (across <= TOOL_RADIUS) & (np.abs(points[:, 2] - height) <= 0.01)
    if not slice_.any():
        return None
    return float(np.max(-relative[slice_, :2] @ direction[:2]))


def _ends_on(points: Array, frame: Array, half: Array) -> bool:
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    return bool(np.all(np.abs(local[:, :2]) <= half - EDGE_MARGIN))


def _hits(tree: KDTree | None, points: Array, shift: Array) -> bool:
    if tree is None:
        return False
    ways = [points[::PUSHED_THINNED, :2] + fraction * shift[:2] for fraction in (0.5, 1.0)]
    return bool(tree.query(np.concatenate(ways))[0].min() < WALL_MARGIN)


def _tool_fits(tool: Array, points: Array) -> bool:
    above = points[points[:, 2] > tool[2] - TIP_BELOW_TCP - 0.002]
    return not np.any(np.linalg.norm(above[:, :2] - tool[:2], axis=1) < TOOL_RADIUS + 0.003)
