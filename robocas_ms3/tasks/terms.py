"""Terms of success and stages: pure functions on batched tensors. N envs, K object slots; metres, N, m/s; wxyz."""

from __future__ import annotations

import torch
from torch import Tensor


def rotate_inverse(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors (..., 3) by the inverse of unit quaternions (..., 4) wxyz."""
    w, xyz = quaternion[..., :1], -quaternion[..., 1:]
    t = 2 * torch.linalg.cross(xyz, vector)
    return vector + w * t + torch.linalg.cross(xyz, t)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors (..., 3) by unit quaternions (..., 4) wxyz."""
    conjugate = torch.cat([quaternion[..., :1], -quaternion[..., 1:]], dim=-1)
    return rotate_inverse(conjugate, vector)


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


def finger_grasps(
    left_force: Tensor,
    right_force: Tensor,
    closing_axis: Tensor,
    *,
    min_force: float = 0.5,
    max_angle_deg: float = 85.0,
) -> Tensor:
    """Which objects both fingers press on, each along its own opening direction.

    The rule of ManiSkill's ``Panda.is_grasping``: the force on each finger is at least ``min_force`` and within
    ``max_angle_deg`` of the direction in which that finger opens.

    Args:
        left_force: (N, K, 3) force of each object on the left finger, world.
        right_force: (N, K, 3) the same on the right finger.
        closing_axis: (N, 3) unit, the direction in which the left finger opens, world.
        min_force: N.
        max_angle_deg: degrees.

    Returns:
        (N, K) bool.
    """
    cosine = torch.cos(torch.deg2rad(torch.as_tensor(max_angle_deg)))
    result = torch.ones(left_force.shape[:2], dtype=torch.bool, device=left_force.device)
    for force, sign in ((left_force, 1.0), (right_force, -1.0)):
        size = torch.linalg.norm(force, dim=-1)
        along = sign * (force * closing_axis[:, None]).sum(-1)
        result &= (size >= min_force) & (along >= cosine * size)
    return result


def touched(forces: Tensor, *, min_force: float = 1e-3) -> Tensor:
    """Which objects any of the gripper's bodies touches.

    Args:
        forces: (N, B, K, 3) contact force between each of B bodies and each object.
        min_force: N; less is noise.

    Returns:
        (N, K) bool.
    """
    return (torch.linalg.norm(forces, dim=-1) >= min_force).any(dim=1)


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
    return (torch.linalg.norm(linear_velocity, dim=-1) <= max_linear) & (
        torch.linalg.norm(angular_velocity, dim=-1) <= max_angular
    )


def tilt(quaternion: Tensor, quaternion_before: Tensor) -> Tensor:
    """(N,) angle in rad between a body's vertical axis now and before, from quaternions (N, 4)."""
    z = torch.zeros_like(quaternion[..., :3])
    z[..., 2] = 1
    now, before = rotate(quaternion, z), rotate(quaternion_before, z)
    # atan2 keeps its precision near 0, where acos does not
    return torch.atan2(torch.linalg.norm(torch.linalg.cross(now, before), dim=-1), (now * before).sum(-1))


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
    shift = torch.linalg.norm(position - position_before, dim=-1)
    return (shift <= max_shift) & (torch.rad2deg(tilt(quaternion, quaternion_before)) <= max_tilt_deg)


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
    z = torch.zeros_like(poses[..., :3])
    z[..., 2] = 1
    position, up, up_at_start = poses[..., :3], rotate(poses[..., 3:], z), rotate(start[..., 3:], z)
    if undo is not None:
        turn = undo[:, None, 3:].expand_as(poses[..., 3:])
        position, up = undo[:, None, :3] + rotate(turn, position), rotate(turn, up)
    angle = torch.atan2(torch.linalg.norm(torch.linalg.cross(up, up_at_start), dim=-1), (up * up_at_start).sum(-1))
    shift = torch.linalg.norm(position - start[..., :3], dim=-1)
    return (shift > max_shift) | (torch.rad2deg(angle) > max_tilt_deg)
