"""Contact forces between a few bodies and many, in one pass over the contacts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from numpy.typing import NDArray

from robocas_ms3.core.arrays import as_tensor

# m between bodies that can't have touched in the last physics step, at whose beginning contacts are found: more than
# they go in 10 ms, at 4 m/s, and where PhysX begins to look for contacts
_NEAR = 0.05

_Boxes = tuple[NDArray[np.float32], NDArray[np.float32]]


class Contacts:
    """Reads the forces between a few bodies and many objects, all pairs at once.

    ManiSkill asks for one pair at a time and, on a CPU, walks over all contacts again for each.

    Args:
        scene: ready to be simulated.
        bodies: B of them.
        objects: K of them.
    """

    def __init__(self, scene: ManiSkillScene, bodies: Sequence[Actor | Link], objects: Sequence[Actor | Link]) -> None:
        self._scene = scene
        self._px: Any = scene.px
        self._shape = (len(bodies), len(objects))
        if scene.gpu_sim_enabled:
            pairs = [
                pair for b in bodies for o in objects for pair in zip(b._bodies, o._bodies, strict=True)
            ]  # one an env
            self._query = self._px.gpu_create_contact_pair_impulse_query(pairs)
        else:
            self._bodies = [body._bodies[0] for body in bodies]
            self._objects = [body._bodies[0] for body in objects]
            self._none = np.zeros((1, *self._shape, 3), np.float32)
            self._boxes: tuple[object, _Boxes] | None = None
            self._rows: dict[Any, int] = {body: i for i, body in enumerate(self._bodies)}
            self._columns: dict[Any, int] = {body: i for i, body in enumerate(self._objects)}

    def forces(self, still: object = None) -> Any:
        """Force that each object exerts on each body, summed over their contact points, in the last physics step.

        Args:
            still: what is the same as at the last call only if the objects have not moved since; None: not known.

        Returns:
            (N, B, K, 3) N, world frame, native (`arrays`); don't write to it.
        """
        if self._scene.gpu_sim_enabled:
            self._px.gpu_query_contact_pair_impulses(self._query)
            impulses = self._query.cuda_impulses.torch().view(*self._shape, -1, 3).permute(2, 0, 1, 3)
            return impulses / self._px.timestep
        if self._apart(still):
            return self._none
        impulses, rows, columns = np.zeros((1, *self._shape, 3), np.float32), self._rows, self._columns
        for contact in self._px.get_contacts():
            first, second = contact.bodies
            if first in rows and second in columns:
                total, sign = impulses[0, rows[first], columns[second]], 1
            elif second in rows and first in columns:
                total, sign = impulses[0, rows[second], columns[first]], -1  # an impulse acts on the first body
            else:
                continue
            for point in contact.points:
                total += sign * point.impulse
        return impulses / np.float32(self._px.timestep)

    def _apart(self, still: object) -> bool:
        """Whether no object is near any body, on a CPU: then there is no need to look through a heap's contacts."""
        if self._boxes is None or still is None or self._boxes[0] != still:
            self._boxes = still, _bounds(self._objects)
        low, high = _bounds(self._bodies)
        others_low, others_high = self._boxes[1]
        gaps = np.maximum(low[:, None] - others_high, others_low - high[:, None])  # (B, K, 3), along each axis
        return bool((gaps.max(-1) > _NEAR).all())


def _bounds(bodies: list[Any]) -> _Boxes:
    """Least and greatest corners (B, 3) of boxes around bodies, world."""
    boxes = np.array([body.get_global_aabb_fast() for body in bodies])
    return boxes[:, 0], boxes[:, 1]


def contact_forces(
    scene: ManiSkillScene, bodies: Sequence[Actor | Link], objects: Sequence[Actor | Link]
) -> torch.Tensor:
    """`Contacts.forces` of bodies that are asked for once."""
    return as_tensor(Contacts(scene, bodies, objects).forces())
