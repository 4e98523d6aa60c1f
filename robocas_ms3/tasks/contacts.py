"""Contact forces between a few bodies and many, in one pass over the contacts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from sapien.physx import PhysxCpuSystem


def contact_forces(
    scene: ManiSkillScene, bodies: Sequence[Actor | Link], objects: Sequence[Actor | Link]
) -> torch.Tensor:
    """Force that each object exerts on each body, summed over their contact points, in the last physics step.

    ManiSkill asks for one pair at a time and, on a CPU, walks over all contacts again for each.

    Returns:
        (N, len(bodies), len(objects), 3) N, world frame.
    """
    if scene.gpu_sim_enabled:
        rows = [torch.stack([scene.get_pairwise_contact_forces(b, o) for o in objects], dim=1) for b in bodies]
        return torch.stack(rows, dim=1)
    forces = torch.zeros(1, len(bodies), len(objects), 3)
    body_index: dict[Any, int] = {b._bodies[0]: i for i, b in enumerate(bodies)}
    object_index: dict[Any, int] = {o._bodies[0]: i for i, o in enumerate(objects)}
    for contact in cast(PhysxCpuSystem, scene.px).get_contacts():
        first, second = contact.bodies
        if first in body_index and second in object_index:
            key, sign = (body_index[first], object_index[second]), 1.0
        elif second in body_index and first in object_index:
            key, sign = (body_index[second], object_index[first]), -1.0  # an impulse acts on the first body
        else:
            continue
        for point in contact.points:
            forces[0, key[0], key[1]] += sign * torch.from_numpy(point.impulse)
    return forces / scene.px.timestep
