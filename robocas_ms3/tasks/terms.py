"""Terms of success and stages: pure functions on batched native arrays (`arrays`).

N envs, K object slots; world frame; m, N, m/s; quaternions wxyz. Flags are bool.
"""

from __future__ import annotations

import math

from robocas_ms3.core.arrays import Array, arange, norm
from robocas_ms3.core.rotations import rotate_inverse, to_matrix, vertical_axis

MIN_GRASP_FORCE = 0.5  # N, on each finger
MAX_GRASP_ANGLE = 85.0  # deg, between the force on a finger and the finger's opening direction
MIN_CONTACT_FORCE = 1e-3  # N; smaller forces are noise
LIFT = 0.03  # m above the object's resting height, as in RoboCAS-v0
REST_SPEED, REST_TURN = 0.03, 0.5  # m/s and rad/s, greatest velocities of a body at rest
BASKET_SHIFT, BASKET_TILT = 0.1, 20.0  # m and deg, allowed motion of the basket, as in RoboCAS-v0
BASKET_DROP, BASKET_FALL = 0.1, 60.0  # m and deg from which a basket has fallen
FALLEN = 0.05  # m below the surface from which an object counts as fallen off it
DISTURBED_SHIFT, DISTURBED_TILT = 0.03, 30.0  # m and deg from which an object counts as disturbed


def is_inside_box(points: Array, box_position: Array, box_quaternion: Array, low: Array, high: Array) -> Array:
    """Return (N,) or (N, K) whether points are inside a box that is fixed to a moving frame.

    Args:
        points: (N, 3) or (N, K, 3).
        box_position: (N, 3) origin of the frame.
        box_quaternion: (N, 4) rotation of the frame.
        low: (3,) least corner in the frame.
        high: (3,) greatest corner in the frame.

    Returns:
        (N,) or (N, K).
    """
    if points.ndim == 3:
        box_position, box_quaternion = box_position[:, None], box_quaternion[:, None]
    local = rotate_inverse(box_quaternion, points - box_position)
    return ((local >= low) & (local <= high)).all(-1)  # pyright: ignore[reportReturnType]


def is_pressed(left_force: Array, right_force: Array) -> Array:
    """Return (N, K) which objects press on both fingers in any direction, from forces (N, K, 3)."""
    return (norm(left_force) >= MIN_GRASP_FORCE) & (norm(right_force) >= MIN_GRASP_FORCE)


def is_grasped(left_force: Array, right_force: Array, closing_axis: Array) -> Array:
    """Return (N, K) which objects press on both fingers along their opening directions.

    Args:
        left_force: (N, K, 3) force of each object on the left finger.
        right_force: (N, K, 3) on the right finger.
        closing_axis: (N, 3) unit vector of the left finger's opening direction.
    """
    opening = closing_axis[:, None]
    return _presses(left_force, opening) & _presses(right_force, -opening)


def _presses(force: Array, opening: Array) -> Array:
    size = norm(force)
    aligned = (force * opening).sum(-1) >= _cosine(MAX_GRASP_ANGLE) * size
    return (size >= MIN_GRASP_FORCE) & aligned


def is_touched(forces: Array) -> Array:
    """Return (N, K) which objects touch any of B bodies, from forces (N, B, K, 3)."""
    return (norm(forces) >= MIN_CONTACT_FORCE).any(1)  # pyright: ignore[reportReturnType]


def is_lifted(height: Array, rest_height: Array, grasped: Array) -> Array:
    """Return (N, K) which objects the gripper holds at least ``LIFT`` above their resting height."""
    return grasped & (height - rest_height >= LIFT)


def is_at_rest(linear_velocity: Array, angular_velocity: Array) -> Array:
    """Return (N,) whether bodies with velocities (N, 3) in m/s and rad/s are at rest."""
    return (norm(linear_velocity) <= REST_SPEED) & (norm(angular_velocity) <= REST_TURN)


def is_basket_standing(position: Array, quaternion: Array, position_before: Array, quaternion_before: Array) -> Array:
    """Return (N,) whether baskets stand within `BASKET_SHIFT` and `BASKET_TILT` of their start poses."""
    shift = norm(position - position_before)
    return (shift <= BASKET_SHIFT) & (_cosine_of_tilt(quaternion, quaternion_before) >= _cosine(BASKET_TILT))


def has_basket_fallen(position: Array, quaternion: Array, position_before: Array, quaternion_before: Array) -> Array:
    """Return (N,) whether baskets have fallen: are lower than at the start, or strongly tilted."""
    dropped = position_before[:, 2] - position[:, 2] > BASKET_DROP
    return dropped | (_cosine_of_tilt(quaternion, quaternion_before) < _cosine(BASKET_FALL))


def has_target_fallen(height: Array, surface: float, above_basket: Array, touched: Array) -> Array:
    """Return (N,) whether targets are below their surface, and neither above the basket nor touched."""
    return (height < surface - FALLEN) & ~above_basket & ~touched


def select_target(values: Array, target: Array) -> Array:
    """Return the values (N, ...) of the targets from values per object (N, K, ...), by slots (N,)."""
    return values[arange(len(target), values), target]


def is_any_other_of_kind(marked: Array, kinds: Array, target: Array) -> Array:
    """Return (N,) whether an object of the target's kind, other than the target, is marked.

    Args:
        marked: (N, K) flags.
        kinds: (N, K) integers that are equal for objects of a kind.
        target: (N,) slots of the targets.
    """
    slots = arange(kinds.shape[1], kinds)
    alike = (kinds == select_target(kinds, target)[:, None]) & (slots != target[:, None])
    return (marked & alike).any(1)  # pyright: ignore[reportReturnType]


def inverse_motion(body: Array, part: Array, part_before: Array) -> tuple[Array, Array]:
    """Return the motion that brings a part of a body, such as a drawer, back to its start pose.

    Args:
        body: (N, 7) pose of the body.
        part: (N, 7) pose of the part.
        part_before: (4, 4) start pose of the part in the body's frame.

    Returns:
        Rotation (N, 3, 3), and translation (N, 3) in m, which is applied after the rotation.
    """
    turned = to_matrix(body[:, 3:])
    turn = turned @ part_before[:3, :3] @ to_matrix(part[:, 3:]).swapaxes(1, 2)
    position = body[:, :3] + turned @ part_before[:3, 3]
    return turn, position - (turn @ part[:, :3, None])[..., 0]


def is_disturbed(poses: Array, start: Array, undo: tuple[Array, Array] | None = None) -> Array:
    """Return (N, K) which objects were shifted or have fallen over.

    Args:
        poses: (N, K, 7) current poses.
        start: (N, K, 7) start poses.
        undo: `inverse_motion` of their support; None: the support can't move.
    """
    position, up = poses[..., :3], vertical_axis(poses[..., 3:])
    if undo is not None:
        turn, shift = undo
        position, up = shift[:, None] + position @ turn.swapaxes(1, 2), up @ turn.swapaxes(1, 2)
    upright = (up * vertical_axis(start[..., 3:])).sum(-1)  # cosine of the tilt
    return (norm(position - start[..., :3]) > DISTURBED_SHIFT) | (upright < _cosine(DISTURBED_TILT))


def _cosine_of_tilt(quaternion: Array, quaternion_before: Array) -> Array:
    return (vertical_axis(quaternion) * vertical_axis(quaternion_before)).sum(-1)


def _cosine(degrees: float) -> float:
    return math.cos(math.radians(degrees))
