"""Terms of success and stages: pure functions on batched tensors. N envs, K object slots; metres, N, m/s; wxyz."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def rotate_inverse(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors (..., 3) by the inverse of unit quaternions (..., 4) wxyz."""
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    t = torch.linalg.cross(vector, xyz)
    return vector + 2 * (w * t + torch.linalg.cross(t, xyz))


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors (..., 3) by unit quaternions (..., 4) wxyz."""
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    t = torch.linalg.cross(xyz, vector)
    return vector + 2 * (w * t + torch.linalg.cross(xyz, t))


def upward(quaternion: Tensor) -> Tensor:
    """(..., 3) the vertical axes of bodies with unit quaternions (..., 4) wxyz."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1)


def inside_box(points: Tensor, box_position: Tensor, box_quaternion: Tensor, low: Tensor, high: Tensor) -> Tensor:
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
    return ((local >= low) & (local <= high)).all(dim=-1)


MIN_GRASP_FORCE = 0.5  # N, on each finger


def pressed(left_force: Tensor, right_force: Tensor) -> Tensor:
    """(N, K) bool: which objects press on both fingers, in whatever direction, from forces (N, K, 3) in N."""
    sizes = torch.linalg.vector_norm(torch.stack([left_force, right_force]), dim=-1)
    return (sizes >= MIN_GRASP_FORCE).all(dim=0)


def finger_grasps(
    left_force: Tensor, right_force: Tensor, closing_axis: Tensor, *, max_angle_deg: float = 85.0
) -> Tensor:
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
    forces = torch.stack([left_force, -right_force])
    size = torch.linalg.vector_norm(forces, dim=-1)
    along = (forces * closing_axis[:, None]).sum(-1)
    aligned = along >= math.cos(math.radians(max_angle_deg)) * size
    return ((size >= MIN_GRASP_FORCE) & aligned).all(dim=0)


def touched(forces: Tensor, *, min_force: float = 1e-3) -> Tensor:
    """Which objects any of the gripper's bodies touches.

    Args:
        forces: (N, B, K, 3) contact force between each of B bodies and each object.
        min_force: N; less is noise.

    Returns:
        (N, K) bool.
    """
    return (torch.linalg.vector_norm(forces, dim=-1) >= min_force).any(dim=1)


def lifted(height: Tensor, rest_height: Tensor, grasped: Tensor, *, by: float = 0.03) -> Tensor:
    """Which objects the gripper holds at least ``by`` metres above where they rested (upstream: 0.03 m).

    Args:
        height: (N, K) of the objects now.
        rest_height: (N, K) after reset.
        grasped: (N, K) bool, see ``finger_grasps``.
        by: m.
    """
    return grasped & (height - rest_height >= by)


def at_rest(
    linear_velocity: Tensor, angular_velocity: Tensor, *, max_linear: float = 0.03, max_angular: float = 0.5
) -> Tensor:
    """(N,) whether bodies with velocities (N, 3) in m/s and rad/s have come to rest."""
    return (torch.linalg.vector_norm(linear_velocity, dim=-1) <= max_linear) & (
        torch.linalg.vector_norm(angular_velocity, dim=-1) <= max_angular
    )


def stands(
    position: Tensor,
    quaternion: Tensor,
    position_before: Tensor,
    quaternion_before: Tensor,
    *,
    max_shift: float = 0.1,
    max_tilt_deg: float = 20.0,
) -> Tensor:
    """(N,) whether a body still stands where it stood: moved and tilted no more than upstream allows a basket."""
    shift = torch.linalg.vector_norm(position - position_before, dim=-1)
    upright = (upward(quaternion) * upward(quaternion_before)).sum(-1)  # cosine of the tilt
    return (shift <= max_shift) & (upright >= math.cos(math.radians(max_tilt_deg)))


def of_target(values: Tensor, target: Tensor) -> Tensor:
    """Pick the target's entry of per-object values: (N, K, ...) and (N,) indices -> (N, ...)."""
    return values[torch.arange(len(target), device=values.device), target]


def another_of_its_kind(marked: Tensor, kinds: Tensor, target: Tensor) -> Tensor:
    """Whether an object of the target's kind, other than the target, is marked.

    Args:
        marked: (N, K) bool.
        kinds: (N, K) numbers; objects of a kind share theirs.
        target: (N,) indices.

    Returns:
        (N,) bool.
    """
    slots = torch.arange(kinds.shape[1], device=kinds.device)
    alike = (kinds == of_target(kinds, target)[:, None]) & (slots != target[:, None])
    return (marked & alike).any(dim=1)


def disturbed(
    poses: Tensor, start: Tensor, undo: Tensor | None = None, *, max_shift: float = 0.03, max_tilt_deg: float = 30.0
) -> Tensor:
    """Which objects are no longer where they stood, or have fallen over.

    Args:
        poses: (N, K, 7) now: position, quaternion wxyz.
        start: (N, K, 7) as they stood.
        undo: (N, 7) motion that brings what they stand on back to where it was; none: it can't move.
        max_shift: m.
        max_tilt_deg: degrees.

    Returns:
        (N, K) bool.
    """
    position, up = poses[..., :3], upward(poses[..., 3:])
    if undo is not None:
        turn = undo[:, None, 3:]
        position, up = undo[:, None, :3] + rotate(turn, position), rotate(turn, up)
    upright = (up * upward(start[..., 3:])).sum(-1)  # cosine of the tilt
    shift = torch.linalg.vector_norm(position - start[..., :3], dim=-1)
    return (shift > max_shift) | (upright < math.cos(math.radians(max_tilt_deg)))
