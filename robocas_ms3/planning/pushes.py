"""Generate candidate pushes of an object, in the arm's base frame. Geometry only, no simulator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.protocol import Array

STAND_OFF = 0.02  # m between tool and object before the push (RoboCAS-v0)
TOOL_RADIUS = 0.012  # m, half the width of the closed fingers
TIP_BELOW_TCP = 0.0085  # m from the TCP to the finger tips
TIP_CLEARANCE = 0.012  # m between finger tips and surface
BELOW_TOP = 0.02  # m below the top of the object; higher the tool would slide over it
# m from the original centre of the object to the end of the push (RoboCAS-v0; the paper: total length 2 d_ext)
PUSH_BEYOND_CENTER = 0.1
EDGE_MARGIN = 0.08  # m from a pushed object to the edge of the surface
WALL_MARGIN = 0.02  # m from a pushed object to furniture and basket
PUSHED_THINNED = 5  # stride over surface points, which are 5 mm apart
COINCIDENT_DISTANCE = 0.01  # m between centres below which the push direction is random (RoboCAS-v0)
TURNS_DEG = (0.0, 20.0, -20.0, 40.0, -40.0, 65.0, -65.0, 90.0, -90.0)  # offsets from the paper's direction
YAWS = 8  # yaw angles of the tool, over half a turn


@dataclass(frozen=True)
class Push:
    """Candidate push on a straight horizontal line.

    Attributes:
        start: (4x4) pose of the TCP at the start.
        direction: (3,) horizontal unit vector.
        length: length of the line, m.
    """

    start: Array
    direction: Array
    length: float

    @property
    def end(self) -> Array:
        """(4x4) pose of the TCP at the end."""
        pose = self.start.copy()
        pose[:3, 3] += self.length * self.direction
        return pose


def generate_push_candidates(
    rng: np.random.Generator,
    points: Array,
    target: Array,
    others: Array,
    surface: tuple[Array, Array],
    fixed: Array,
    turn_deg: float = 0.0,
) -> Iterator[Push]:
    """Yield pushes of an obstacle away from the target, the paper's direction first.

    The closed fingers (the tool) are collision-free at the start of a push, and the obstacle ends on the surface. The
    obstacle may touch other objects during the push, but neither furniture nor basket. The tool touches the obstacle at
    the height of the target, or at the lowest free height above.

    Args:
        rng: random generator, for the direction if target and obstacle have the same centre.
        points: (P, 3) surface points of the obstacle, m; z is up.
        target: (3,) centre of the target, m.
        others: (Q, 3) surface points of all other bodies, m.
        surface: pose (4x4) of the centre of the surface, and its half size (2,) in m.
        fixed: (R, 3) surface points of furniture and basket, m.
        turn_deg: angle by which all directions are rotated about the vertical, deg.
    """
    frame, half = surface
    walls = fixed[(fixed[:, 2] > frame[2, 3] + 0.01) & (fixed[:, 2] < points[:, 2].max())][:, :2]
    tree = KDTree(walls) if len(walls) else None
    center = points.mean(axis=0)
    ahead = compute_push_direction(rng, center, target)
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
            extent = measure_extent_behind(points, center, direction, height)
            if extent is None:
                continue
            tool = np.array([*center[:2], height]) - (extent + STAND_OFF + TOOL_RADIUS) * direction
            if not does_tool_fit(tool, near):
                continue
            length = STAND_OFF + extent + PUSH_BEYOND_CENTER
            shift = (length - STAND_OFF) * direction
            if not _ends_on_surface(points + shift, frame, half) or _hits(tree, points, shift):
                continue
            yield from push_yaws(tool, direction, length)
            break  # a push higher up would tip the object


def push_yaws(tool: Array, direction: Array, length: float) -> list[Push]:
    """Return the same push with ``YAWS`` yaw angles of the tool.

    Args:
        tool: (3,) position of the TCP at the start, m.
        direction: (3,) horizontal unit vector.
        length: length of the line, m.
    """
    yaw, pushes = np.arctan2(direction[1], direction[0]), []
    for k in range(YAWS):
        start = np.eye(4)
        start[:3, :3] = (Rotation.from_euler("z", yaw + k * np.pi / YAWS) * _DOWN).as_matrix()
        start[:3, 3] = tool
        pushes.append(Push(start, direction, length))
    return pushes


_DOWN = Rotation.from_euler("x", np.pi)


def compute_push_direction(rng: np.random.Generator, center: Array, target: Array) -> Array:
    """Return the push direction of the paper, v_push: horizontal unit vector (3,) from target to obstacle.

    If the centres are less than 1 cm apart, the direction is random, within 30 deg of the direction to the origin (the
    arm's base).

    Args:
        rng: random generator.
        center: (3,) centre of the obstacle, m.
        target: (3,) centre of the target, m.
    """
    away = np.append((center - target)[:2], 0.0)
    if np.linalg.norm(away) < COINCIDENT_DISTANCE:
        home = np.append(-center[:2], 0.0)
        away = Rotation.from_euler("z", rng.uniform(-30, 30), degrees=True).apply(home)
    return away / np.linalg.norm(away)


def measure_extent_behind(points: Array, center: Array, direction: Array, height: float) -> float | None:
    """Return the extent d_ext of the paper: from an object's centre to its side that the tool touches, m.

    Only points that the tool can touch count: at most the tool radius from the line of the push and 1 cm from its
    height. The result is None if there is no such point.

    Args:
        points: (P, 3) surface points of the object, m.
        center: (3,) centre of the object, m.
        direction: (3,) horizontal unit vector of the push.
        height: height of the push, m.
    """
    relative = points - center
    across = np.abs(relative[:, :2] @ np.array([-direction[1], direction[0]]))
    slice_ = (across <= TOOL_RADIUS) & (np.abs(points[:, 2] - height) <= 0.01)
    if not slice_.any():
        return None
    return float(np.max(-relative[slice_, :2] @ direction[:2]))


def _ends_on_surface(points: Array, frame: Array, half: Array) -> bool:
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    return bool(np.all(np.abs(local[:, :2]) <= half - EDGE_MARGIN))


def _hits(tree: KDTree | None, points: Array, shift: Array) -> bool:
    if tree is None:
        return False
    ways = [points[::PUSHED_THINNED, :2] + fraction * shift[:2] for fraction in (0.5, 1.0)]
    return bool(tree.query(np.concatenate(ways))[0].min() < WALL_MARGIN)


def does_tool_fit(tool: Array, points: Array) -> bool:
    """Return whether the closed fingers touch none of some points (P, 3) while they move straight down to ``tool``.

    ``tool`` (3,) is the position of the TCP, m.
    """
    above = points[points[:, 2] > tool[2] - TIP_BELOW_TCP - 0.002]
    return not np.any(np.linalg.norm(above[:, :2] - tool[:2], axis=1) < TOOL_RADIUS + 0.003)
