"""Terms of success and stages: pure functions on batched arrays. N envs, K object slots; metres, N, m/s; wxyz.

They take tensors or NumPy's arrays, see `arrays`: all arguments of one kind, which is also that of what they give.
"""

from __future__ import annotations

import math

from robocas_ms3.core.arrays import Array, count_up, length
from robocas_ms3.core.rotations import rotate_inverse, rotation, upward


def inside_box(points: Array, box_position: Array, box_quaternion: Array, low: Array, high: Array) -> Array:
    """Whether points lie in a box fixed to a moving frame.

    Args:
        points: (N, 3) or (N, K, 3) world.
        box_position: (N, 3) world, origin of the frame.
        box_quaternion: (N, 4) of the frame.
        low: (3,) least corner in the frame.
        high: the same, greatest corner.

    Returns:
        (N,) or (N, K) bool.
    """
    if points.ndim == 3:
        box_position, box_quaternion = box_position[:, None], box_quaternion[:, None]
    local = rotate_inverse(box_quaternion, points - box_position)
    return ((local >= low) & (local <= high)).all(-1)  # pyright: ignore[reportReturnType]


MIN_GRASP_FORCE = 0.5  # N, on each finger


def pressed(left_force: Array, right_force: Array) -> Array:
    """(N, K) bool: which objects press on both fingers, in whatever direction, from forces (N, K, 3) in N."""
    return (length(left_force) >= MIN_GRASP_FORCE) & (length(right_force) >= MIN_GRASP_FORCE)


def finger_grasps(left_force: Array, right_force: Array, closing_axis: Array, *, max_angle_deg: float = 85.0) -> Array:
    """Which objects both fingers press on, each along its own opening direction.

    The rule of ManiSkill's ``Panda.is_grasping``: the force on each finger is at least ``MIN_GRASP_FORCE`` and within
    ``max_angle_deg`` of the direction in which that finger opens.

    Args:
        left_force: (N, K, 3) force of each object on the left finger, world.
        right_force: (N, K, 3) the same on the right finger.
        closing_axis: (N, 3) unit, the direction in which the left finger opens, world.
        max_angle_deg: degrees.

    Returns:
        (N, K) bool.
    """
    opening = closing_axis[:, None]
    return _presses(left_force, opening, max_angle_deg) & _presses(right_force, -opening, max_angle_deg)


def _presses(force: Array, opening: Array, max_angle_deg: float) -> Array:
    size = length(force)
    aligned = (force * opening).sum(-1) >= math.cos(math.radians(max_angle_deg)) * size
    return (size >= MIN_GRASP_FORCE) & aligned


def touched(forces: Array, *, min_force: float = 1e-3) -> Array:
    """Which objects any of the gripper's bodies touches.

    Args:
        forces: (N, B, K, 3) contact force between each of B bodies and each object.
        min_force: N; less is noise.

    Returns:
        (N, K) bool.
    """
    return (length(forces) >= min_force).any(1)  # pyright: ignore[reportReturnType]


def lifted(height: Array, rest_height: Array, grasped: Array, *, by: float = 0.03) -> Array:
    """Which objects the gripper holds at least ``by`` metres above where they rested (upstream: 0.03 m).

    Args:
        height: (N, K) of the objects now.
        rest_height: (N, K) after reset.
        grasped: (N, K) bool, see ``finger_grasps``.
        by: m.
    """
    return grasped & (height - rest_height >= by)


def at_rest(
    linear_velocity: Array, angular_velocity: Array, *, max_linear: float = 0.03, max_angular: float = 0.5
) -> Array:
    """(N,) whether bodies with velocities (N, 3) in m/s and rad/s have come to rest."""
    return (length(linear_velocity) <= max_linear) & (length(angular_velocity) <= max_angular)


def stands(
    position: Array,
    quaternion: Array,
    position_before: Array,
    quaternion_before: Array,
    *,
    max_shift: float = 0.1,
    max_tilt_deg: float = 20.0,
) -> Array:
    """(N,) whether a body still stands where it stood: moved and tilted no more than upstream allows a basket."""
    shift = length(position - position_before)
    upright = (upward(quaternion) * upward(quaternion_before)).sum(-1)  # cosine of the tilt
    return (shift <= max_shift) & (upright >= math.cos(math.radians(max_tilt_deg)))


FALLEN = 0.05  # m below the surface that objects stand on, at which one counts as fallen off it


def fell_off(height: Array, surface: float, above_basket: Array, touched: Array, *, by: float = FALLEN) -> Array:
    """Whether targets lie, or fall, below what they stood on, neither in the basket nor in the gripper.

    Args:
        height: (N,) of the targets, m.
        surface: of what they stood on, m.
        above_basket: (N,) bool, which are within the basket's outline, seen from above.
        touched: (N,) bool, which the gripper touches.
        by: m.

    Returns:
        (N,) bool.
    """
    return (height < surface - by) & ~above_basket & ~touched


def fell_over(
    position: Array,
    quaternion: Array,
    position_before: Array,
    quaternion_before: Array,
    *,
    max_drop: float = 0.1,
    max_tilt_deg: float = 60.0,
) -> Array:
    """(N,) whether a body has fallen: lower than it stood by more than ``max_drop`` m, or tilted past turning back."""
    dropped = position_before[:, 2] - position[:, 2] > max_drop
    upright = (upward(quaternion) * upward(quaternion_before)).sum(-1)  # cosine of the tilt
    return dropped | (upright < math.cos(math.radians(max_tilt_deg)))


def of_target(values: Array, target: Array) -> Array:
    """Pick the target's entry of per-object values: (N, K, ...) and (N,) indices -> (N, ...)."""
    return values[count_up(len(target), values), target]


def another_of_its_kind(marked: Array, kinds: Array, target: Array) -> Array:
    """Whether an object of the target's kind, other than the target, is marked.

    Args:
        marked: (N, K) bool.
        kinds: (N, K) numbers; objects of a kind share theirs.
        target: (N,) indices.

    Returns:
        (N,) bool.
    """
    slots = count_up(kinds.shape[1], kinds)
    alike = (kinds == of_target(kinds, target)[:, None]) & (slots != target[:, None])
    return (marked & alike).any(1)  # pyright: ignore[reportReturnType]


def way_back(body: Array, part: Array, part_before: Array) -> tuple[Array, Array]:
    """The motion that brings a part of a body, such as a drawer, back to where it was, in the world.

    Args:
        body: (N, 7) pose in the world.
        part: (N, 7) the same of the part.
        part_before: (4, 4) pose of the part in the body's frame, as it was.

    Returns:
        Rotation (N, 3, 3) and translation (N, 3), m, to be applied after it.
    """
    turned = rotation(body[:, 3:])
    turn = turned @ part_before[:3, :3] @ rotation(part[:, 3:]).swapaxes(1, 2)
    position = body[:, :3] + turned @ part_before[:3, 3]
    return turn, position - (turn @ part[:, :3, None])[..., 0]


def disturbed(
    poses: Array,
    start: Array,
    undo: tuple[Array, Array] | None = None,
    *,
    max_shift: float = 0.03,
    max_tilt_deg: float = 30.0,
) -> Array:
    """Which objects are no longer where they stood, or have fallen over.

    Args:
        poses: (N, K, 7) now: position, quaternion wxyz.
        start: (N, K, 7) as they stood.
        undo: `way_back` of what they stand on; none: it can't move.
        max_shift: m.
        max_tilt_deg: degrees.

    Returns:
        (N, K) bool.
    """
    position, up = poses[..., :3], upward(poses[..., 3:])
    if undo is not None:
        turn, shift = undo
        position, up = shift[:, None] + position @ turn.swapaxes(1, 2), up @ turn.swapaxes(1, 2)
    upright = (up * upward(start[..., 3:])).sum(-1)  # cosine of the tilt
    shift = length(position - start[..., :3])
    return (shift > max_shift) | (upright < math.cos(math.radians(max_tilt_deg)))
