"""Terms of success and stages: pure functions on batched arrays, all of one kind (`arrays`).

N envs, K object slots; world frame, metres, N, m/s; quaternions wxyz. Flags are bool.
"""

from __future__ import annotations

import math

from robocas_ms3.core.arrays import Array, arange, norm
from robocas_ms3.core.rotations import rotate_inverse, to_matrix, vertical_axis

MIN_GRASP_FORCE = 0.5  # N, on each finger
MAX_GRASP_ANGLE = 85.0  # deg between the force on a finger and the direction in which it opens
MIN_CONTACT_FORCE = 1e-3  # N; less is noise
LIFT = 0.03  # m above where an object rested, as in RoboCAS-v0
REST_SPEED, REST_TURN = 0.03, 0.5  # m/s and rad/s of a body at rest
BASKET_SHIFT, BASKET_TILT = 0.1, 20.0  # m and deg that a basket may be moved, as in RoboCAS-v0
BASKET_DROP, BASKET_FALL = 0.1, 60.0  # m and deg at which a basket has fallen
FALLEN = 0.05  # m below the surface that objects stand on, at which one counts as fallen off it
DISTURBED_SHIFT, DISTURBED_TILT = 0.03, 30.0  # m and deg at which an object no longer stands as it stood


def is_inside_box(points: Array, box_position: Array, box_quaternion: Array, low: Array, high: Array) -> Array:
    """Return whether points are in a box that is fixed to a moving frame.

    Args:
        points: (N, 3) or (N, K, 3).
        box_position: (N, 3), origin of the frame.
        box_quaternion: (N, 4) of the frame.
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
    """Return which objects (N, K) press on both fingers, in any direction, from forces (N, K, 3)."""
    return (norm(left_force) >= MIN_GRASP_FORCE) & (norm(right_force) >= MIN_GRASP_FORCE)


def is_grasped(left_force: Array, right_force: Array, closing_axis: Array) -> Array:
    """Return which objects (N, K) press on both fingers, each in its own opening direction, as ``Panda.is_grasping``.

    Args:
        left_force: (N, K, 3) force of each object on the left finger.
        right_force: (N, K, 3) on the right finger.
        closing_axis: (N, 3) unit, the direction in which the left finger opens.
    """
    opening = closing_axis[:, None]
    return _presses(left_force, opening) & _presses(right_force, -opening)


def _presses(force: Array, opening: Array) -> Array:
    size = norm(force)
    aligned = (force * opening).sum(-1) >= _cosine(MAX_GRASP_ANGLE) * size
    return (size >= MIN_GRASP_FORCE) & aligned


def is_touched(forces: Array) -> Array:
    """Return which objects (N, K) touch any of B bodies, from the forces (N, B, K, 3) between them."""
    return (norm(forces) >= MIN_CONTACT_FORCE).any(1)  # pyright: ignore[reportReturnType]


def is_lifted(height: Array, rest_height: Array, grasped: Array) -> Array:
    """Return which objects (N, K) the gripper holds at least ``LIFT`` above where they rested."""
    return grasped & (height - rest_height >= LIFT)


def is_at_rest(linear_velocity: Array, angular_velocity: Array) -> Array:
    """Return whether bodies with velocities (N, 3) in m/s and rad/s are at rest, (N,)."""
    return (norm(linear_velocity) <= REST_SPEED) & (norm(angular_velocity) <= REST_TURN)


def is_basket_standing(position: Array, quaternion: Array, position_before: Array, quaternion_before: Array) -> Array:
    """Return whether baskets still stand where they stood, (N,)."""
    shift = norm(position - position_before)
    return (shift <= BASKET_SHIFT) & (_cosine_of_tilt(quaternion, quaternion_before) >= _cosine(BASKET_TILT))


def has_basket_fallen(position: Array, quaternion: Array, position_before: Array, quaternion_before: Array) -> Array:
    """Return whether baskets have fallen: are lower than they stood, or tilted past turning back, (N,)."""
    dropped = position_before[:, 2] - position[:, 2] > BASKET_DROP
    return dropped | (_cosine_of_tilt(quaternion, quaternion_before) < _cosine(BASKET_FALL))


def has_target_fallen(height: Array, surface: float, above_basket: Array, touched: Array) -> Array:
    """Return whether targets (N,) are below the surface that they stood on, neither above the basket nor touched."""
    return (height < surface - FALLEN) & ~above_basket & ~touched


def select_target(values: Array, target: Array) -> Array:
    """Return the target's entry (N, ...) of values per object (N, K, ...), by its slot (N,)."""
    return values[arange(len(target), values), target]


def is_any_other_of_kind(marked: Array, kinds: Array, target: Array) -> Array:
    """Return whether an object of the target's kind other than the target is marked, (N,).

    Args:
        marked: (N, K).
        kinds: (N, K) integers; objects of a kind share theirs.
        target: (N,) slots.
    """
    slots = arange(kinds.shape[1], kinds)
    alike = (kinds == select_target(kinds, target)[:, None]) & (slots != target[:, None])
    return (marked & alike).any(1)  # pyright: ignore[reportReturnType]


def inverse_motion(body: Array, part: Array, part_before: Array) -> tuple[Array, Array]:
    """Return the motion that brings a part of a body, such as a drawer, back to where it was.

    Args:
        body: (N, 7) pose.
        part: (N, 7) pose of the part.
        part_before: (4, 4) pose of the part in the body's frame, as it was.

    Returns:
        Rotation (N, 3, 3) and translation (N, 3), m, to be applied after it.
    """
    turned = to_matrix(body[:, 3:])
    turn = turned @ part_before[:3, :3] @ to_matrix(part[:, 3:]).swapaxes(1, 2)
    position = body[:, :3] + turned @ part_before[:3, 3]
    return turn, position - (turn @ part[:, :3, None])[..., 0]


def is_disturbed(poses: Array, start: Array, undo: tuple[Array, Array] | None = None) -> Array:
    """Return which objects (N, K) are no longer where they stood, or have fallen over.

    Args:
        poses: (N, K, 7) now.
        start: (N, K, 7) as they stood.
        undo: `inverse_motion` of what they stand on; None: it can't move.
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
