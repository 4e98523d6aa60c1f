"""What only a simulator knows: privileged observations, (N, D) each; see docs/rl.md."""

from __future__ import annotations

from typing import Any

import torch

from robocas_ms3.core.arrays import as_tensor, join, native
from robocas_ms3.tasks import terms


def privileged_observations(env: Any) -> dict[str, torch.Tensor]:
    """Return the poses of objects and basket, and the target's place relative to the TCP and the goal."""
    state, tcp = env.bodies.read(), env.tcp_in_world()
    objects, basket = env.bodies.objects(state), env.bodies.basket(state)
    center = env.target_center(native(objects))
    observations = {
        "object_poses": torch.where(env.present[..., None], objects[..., :7], 0.0).flatten(1),
        "target": env.is_target.float(),
        **({} if basket is None else {"basket_pose": basket}),
    }
    to_target = center - tcp[:, :3]
    point = env.goal.point(None if basket is None else native(basket))
    if point is None:
        observations["tcp_to_target"] = in_tcp_frame(tcp, to_target[:, None])[:, 0]
    else:
        seen = in_tcp_frame(tcp, join([to_target, point - center]).reshape(-1, 2, 3))
        observations |= {"tcp_to_target": seen[:, 0], env.goal.TOWARDS: seen[:, 1]}
    return observations | {"target_extents": env.target_extents}


def in_tcp_frame(tcp: Any, vectors: Any) -> torch.Tensor:
    """Return vectors (N, V, 3) of the world along the axes of poses (N, 7); both native (`arrays`)."""
    return as_tensor(vectors @ terms.rotation(tcp[:, 3:]))
