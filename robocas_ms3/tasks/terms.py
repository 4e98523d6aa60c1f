"""Terms of success and stages: pure functions on batched native arrays (`core.arrays`).

N envs, K object slots. Positions are in m, forces in newtons, velocities in m/s and rad/s, all in the world frame.
Quaternions are wxyz. Functions whose names begin with ``is`` or ``has`` return bool.
"""

from __future__ import annotations

import math

from robocas_ms3.core.arrays import Array, arange, norm
from robocas_ms3.core.rotations import rotate_inverse, to_matrix, vertical_axis

MIN_GRASP_FORCE = 0.5  # N, on each finger
MAX_GRASP_ANGLE = 85.0  # deg, between the force on a finger and the finger's opening direction
MIN_GRASP_WIDTH = 0.002  # m between the finger pads; closed fingers that press on an object do not hold it
MIN_CONTACT_FORCE = 1e-3  # N; smaller forces are noise
LIFT = 0.03  # m above the object's resting height, as in RoboCAS-v0
REST_SPEED, REST_TURN = 0.03, 0.5  # m/s and rad/s, greatest velocities of a body at rest
BASKET_SHIFT, BASKET_TILT = 0.1, 20.0  # m and deg, allowed motion of the basket, as in RoboCAS-v0
BASKET_DROP, BASKET_FALL = 0.1, 60.0  # m and deg from which a basket has fallen
FALLEN = 0.05  # m below the surface from which an object counts as fallen off it
DISTURBED_SHIFT, DISTURBED_TILT = 0.03, 30.0  # m and deg from which an object counts as disturbed


def is_inside_box(
    points: Array, box_position: Array, box_quaternion: Array, lower_corner: Array, upper_corner: Array
) -> Array:
    """Return whether points are inside a box that is fixed to a moving frame.

    Args:
        points: (N, 3) or (N, K, 3).
        box_position: (N, 3) origin of the frame.
        box_quaternion: (N, 4) rotation of the frame.
        lower_corner: (3,) least coordinates of the box in the frame.
        upper_corner: (3,) greatest coordinates of the box in the frame.

    Returns:
        (N,) or (N, K) bool.
    """
    if points.ndim == 3:
        box_position, box_quaternion = box_position[:, None], box_quaternion[:, None]
    local = rotate_inverse(box_quaternion, points - box_position)
    return ((local >= lower_corner) & (local <= upper_corner)).all(-1)  # pyright: ignore[reportReturnType]


def presses_both_fingers(left_force: Array, right_force: Array) -> Array:
    """Return (N, K) bool, whether each object presses on both fingers, from forces (N, K, 3)."""
    return (norm(left_force) >= MIN_GRASP_FORCE) & (norm(right_force) >= MIN_GRASP_FORCE)


def is_grasped(left_force: Array, right_force: Array, opening_axis: Array) -> Array:
    """Return (N, K) bool, whether each object presses both fingers apart.

    Args:
        left_force: (N, K, 3) force of each object on the left finger.
        right_force: (N, K, 3) force of each object on the right finger.
        opening_axis: (N, 3) unit vector in which the left finger opens; the right finger opens in the other direction.
    """
    opening = opening_axis[:, None]
    return _presses(left_force, opening) & _presses(right_force, -opening)


def _presses(force: Array, opening: Array) -> Array:
    size = norm(force)
    aligned = (force * opening).sum(-1) >= _cosine(MAX_GRASP_ANGLE) * size
    return (size >= MIN_GRASP_FORCE) & aligned


def is_touched(forces: Array) -> Array:
    """Return (N, K) bool, whether each object touches any of B bodies, from forces (N, B, K, 3)."""
    return (norm(forces) >= MIN_CONTACT_FORCE).any(1)  # pyright: ignore[reportReturnType]


def is_lifted(height: Array, rest_height: Array, grasped: Array) -> Array:
    """Return (N, K) bool, whether each object is grasped at least ``LIFT`` above its resting height."""
    return grasped & (height - rest_height >= LIFT)


def is_at_rest(linear_velocity: Array, angular_velocity: Array) -> Array:
    """Return (N,) bool, whether bodies with velocities (N, 3) in m/s and rad/s are at rest."""
    return (norm(linear_velocity) <= REST_SPEED) & (norm(angular_velocity) <= REST_TURN)


def is_basket_standing(position: Array, quaternion: Array, start_position: Array, start_quaternion: Array) -> Array:
    """Return (N,) bool, whether baskets are shifted and tilted by no more than the allowed values.

    The values are `BASKET_SHIFT` and `BASKET_TILT`.
    """
    shift = norm(position - start_position)
    return (shift <= BASKET_SHIFT) & (_cosine_of_tilt(quaternion, start_quaternion) >= _cosine(BASKET_TILT))


def has_basket_fallen(position: Array, quaternion: Array, start_position: Array, start_quaternion: Array) -> Array:
    """Return (N,) bool, whether baskets are lower by `BASKET_DROP` or tilted by `BASKET_FALL`."""
    dropped = start_position[:, 2] - position[:, 2] > BASKET_DROP
    return dropped | (_cosine_of_tilt(quaternion, start_quaternion) < _cosine(BASKET_FALL))


def has_target_fallen(height: Array, surface: float, above_basket: Array, touched: Array) -> Array:
    """Return (N,) bool, whether targets are below their surface, not above the basket, and not touched."""
    return (height < surface - FALLEN) & ~above_basket & ~touched


def select_target(values: Array, target_slot: Array) -> Array:
    """Return the target's values (N, ...) from the values (N, K, ...) of all objects, by target slot (N,)."""
    return values[arange(len(target_slot), values), target_slot]


def has_other_of_kind(flags: Array, kinds: Array, target_slot: Array) -> Array:
    """Return (N,) bool, whether a flag is true for another object of the target's kind.

    Args:
        flags: (N, K) bool, one flag per object.
        kinds: (N, K) integers; objects of the same kind have equal integers.
        target_slot: (N,) slot of each target.
    """
    slots = arange(kinds.shape[1], kinds)
    alike = (kinds == select_target(kinds, target_slot)[:, None]) & (slots != target_slot[:, None])
    return (flags & alike).any(1)  # pyright: ignore[reportReturnType]


def inverse_part_motion(body_pose: Array, part_pose: Array, start_part_in_body: Array) -> tuple[Array, Array]:
    """Return the motion that brings a moving part, such as a drawer, back to its start pose in its body.

    Args:
        body_pose: (N, 7) world pose of the body, such as a cabinet.
        part_pose: (N, 7) world pose of the part.
        start_part_in_body: (4, 4) start pose of the part in the frame of the body.

    Returns:
        Rotation (N, 3, 3) and translation (N, 3) in m, in the world frame; the translation is applied last.
    """
    body_rotation = to_matrix(body_pose[:, 3:])
    turn = body_rotation @ start_part_in_body[:3, :3] @ to_matrix(part_pose[:, 3:]).swapaxes(1, 2)
    position = body_pose[:, :3] + body_rotation @ start_part_in_body[:3, 3]
    return turn, position - (turn @ part_pose[:, :3, None])[..., 0]


def is_disturbed(poses: Array, start_poses: Array, undo: tuple[Array, Array] | None = None) -> Array:
    """Return (N, K) bool, whether each object was shifted or tilted since the start.

    The limits are `DISTURBED_SHIFT` and `DISTURBED_TILT`.

    Args:
        poses: (N, K, 7) current world poses of the objects.
        start_poses: (N, K, 7) world poses of the objects at the start.
        undo: result of `inverse_part_motion` for the part that supports the objects; None: the support can't move.
    """
    position, up = poses[..., :3], vertical_axis(poses[..., 3:])
    if undo is not None:
        turn, shift = undo
        position, up = shift[:, None] + position @ turn.swapaxes(1, 2), up @ turn.swapaxes(1, 2)
    upright = (up * vertical_axis(start_poses[..., 3:])).sum(-1)  # cosine of the tilt
    return (norm(position - start_poses[..., :3]) > DISTURBED_SHIFT) | (upright < _cosine(DISTURBED_TILT))


def _cosine_of_tilt(quaternion: Array, start_quaternion: Array) -> Array:
    return (vertical_axis(quaternion) * vertical_axis(start_quaternion)).sum(-1)


def _cosine(degrees: float) -> float:
    return math.cos(math.radians(degrees))
