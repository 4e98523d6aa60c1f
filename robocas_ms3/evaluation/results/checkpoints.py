"""Checkpoints of an episode: states as rows of numbers, and how an environment is set to one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from robocas_ms3.tasks.bodies import BODY

SMALL_DEVIATION = 0.01
"""Distance of a body from its recorded position that counts as small, m."""
_POSE = 7  # numbers of a pose at the start of the state of a body


class StateDeviation(NamedTuple):
    """Distance of a state of an environment from a checkpoint.

    Attributes:
        target: distance of the target or the basket from its position in the checkpoint, the larger one, m.
        body: the same for the movable actor that is farthest from its position, m.
        joint: largest difference of a joint position, rad or m.
        moved: sum of the distances of the other movable actors, without those up to `SMALL_DEVIATION`, m.
    """

    target: float
    body: float
    joint: float
    moved: float


def flatten_state(state: Mapping[str, Any]) -> torch.Tensor:
    """Return a state of N envs, such as `SceneEnv.extra_state`, as rows (N, D) float32, in the order of its entries."""
    return torch.cat([value.reshape(len(value), -1).float() for value in _list_values(state)], dim=1)


def unflatten_state(like: Mapping[str, Any], row: np.ndarray) -> dict[str, Any]:
    """Return the state of one env from a row of `flatten_state`, which may be longer, with the shapes of ``like``."""
    values, start = {}, 0
    for name, value in like.items():
        if isinstance(value, Mapping):
            values[name], size = unflatten_state(value, row[start:]), len(flatten_state(value)[0])
        else:
            size = value.numel()
            values[name] = torch.from_numpy(row[start : start + size]).reshape(value.shape)
        start += size
    return values


def restore_checkpoint(base: Any, checkpoint: np.ndarray, tolerance: float) -> tuple[StateDeviation, list[str]]:
    """Set poses and joint positions of a single env to those of a checkpoint if they are far from it.

    Then stages that were reached, but not in the checkpoint, are not reached any more. Velocities, controllers, other
    stages, metrics and the weld stay as they are.

    Args:
        base: the RoboCAS environment.
        checkpoint: (D,), a checkpoint of this episode (`action_wrapper.PolicyActionWrapper`).
        tolerance: deviation in m or rad up to which nothing is set. Setting a state has an effect on contacts: a
            weak grasp can slip. Infinite: only measure.

    Returns:
        How far the state was from the checkpoint, and the stages that are not reached any more.
    """
    bodies = base.bodies
    present = bodies.read()
    recorded = torch.from_numpy(checkpoint)[None, : present.shape[1]]
    change = bodies.to_state_dict(recorded - present)
    distances = {name: float(body[0, :3].norm()) for name, body in change["actors"].items()}
    joints = torch.cat([jointed[:, _joint_positions(jointed)] for jointed in change["articulations"].values()], dim=1)
    placed = {base.objects[int(base.target_slot[0])].name} | ({"basket"} & distances.keys())
    deviation = StateDeviation(  # np.max returns NaN if a value is NaN; max may not
        target=float(np.max([distances[name] for name in placed])),
        body=float(np.max(list(distances.values()))),
        joint=float(joints.abs().max()),
        moved=float(
            np.sum([far for name, far in distances.items() if name not in placed and not far <= SMALL_DEVIATION])
        ),
    )
    if all(value <= tolerance for value in deviation):
        return deviation, []
    state, target = base.get_state_dict(), bodies.to_state_dict(recorded)
    for name, body in target["actors"].items():
        state["actors"][name] = torch.cat([body[:, :_POSE], state["actors"][name][:, _POSE:]], dim=1)
    for name, jointed in target["articulations"].items():
        state["articulations"][name] = state["articulations"][name].clone()
        state["articulations"][name][:, _joint_positions(jointed)] = jointed[:, _joint_positions(jointed)]
    recorded_extra = unflatten_state(base.extra_state(), checkpoint[present.shape[1] :])
    reached = state["task"]["stages"]
    lost = reached & (recorded_extra["task"]["stages"] == 0)
    state["task"]["stages"] = reached & ~lost
    base.set_state_dict(state)
    return deviation, [name for name, is_lost in zip(base.success_check.stages, lost[0], strict=True) if is_lost]


def _list_values(state: Mapping[str, Any]) -> Iterator[torch.Tensor]:
    for value in state.values():
        if isinstance(value, Mapping):
            yield from _list_values(value)
        else:
            yield value


def _joint_positions(state: torch.Tensor) -> slice:
    """Return the columns of the joint positions in the state of an articulation: root, positions, velocities."""
    return slice(BODY, (BODY + state.shape[1]) // 2)
