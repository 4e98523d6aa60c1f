"""A recorded episode to be replayed: all that its files say, checked before a simulator is told any of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from mani_skill.trajectory.utils import dict_to_list_of_dicts
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.recordings.entries import read_reset, was_taken_over
from robocas_ms3.demos.recordings.stored import (
    BODIES,
    check_bodies,
    check_finite,
    open_episode,
    open_trajectory,
    read_actions,
    read_states,
)
from robocas_ms3.tasks.base import RoboCASEnv

_JOINT_TARGETS = 8  # numbers of an action that can be converted


@dataclass(frozen=True)
class Recorded:
    """A recorded episode of S steps.

    Attributes:
        where: it is, for messages.
        seed, options: of ``env.reset``.
        control_mode: of the actions.
        actions: (S, A).
        states: S + 1, each as ``set_state_dict`` takes it.
        taken_over: whether it begins at the first of them, to which the seed alone does not lead.
    """

    where: str
    seed: int
    options: dict[str, Any]
    control_mode: str
    actions: NDArray[np.float32]
    states: list[dict[str, Any]]
    taken_over: bool

    @classmethod
    def read(cls, trajectory: Path, episode: dict[str, Any]) -> Recorded:
        """Read an episode.

        Args:
            trajectory: HDF5 file.
            episode: what the JSON beside it says of the episode.
        """
        where = f"{trajectory}, traj_{episode['episode_id']}"
        seed, options = read_reset(episode, where)
        mode = episode.get("control_mode")
        if not isinstance(mode, str):
            found = str(mode)[:40]
            raise DatasetError("no such control mode", where=f"{where}, control_mode", expected="text", found=found)
        with open_trajectory(trajectory) as file:
            group = open_episode(file, episode["episode_id"])
            actions, states = read_actions(group), read_states(group)
        for name, rows in _named(states):
            if rows.dtype.kind not in "fbiu" or rows.shape[:1] != (len(actions) + 1,):
                raise DatasetError(
                    "this episode is damaged",
                    where=f"{where}, {name}",
                    expected=f"{len(actions) + 1} rows of numbers, one more than actions",
                    found=f"{rows.dtype} of shape {rows.shape}",
                )
            check_finite(rows, f"{where}, {name}")
        check_bodies(states, where)
        return cls(where, seed, options, mode, actions, dict_to_list_of_dicts(states), was_taken_over(episode))

    def check_fits(self, env: RoboCASEnv) -> None:
        """See that an environment, reset for this episode, is such a one as it was recorded in."""
        converted = env.control_mode != self.control_mode
        width = _JOINT_TARGETS if converted else cast(Any, env.single_action_space).shape[0]
        if self.actions.shape[1] != width:
            found = self.actions.shape[1]
            raise DatasetError("actions of another robot", where=self.where, expected=f"{width} numbers", found=found)
        theirs = {name: np.size(row) for name, row in _named(self.states[0])}
        ours = {name: np.size(row.cpu().numpy()) for name, row in _named(env.get_state_dict())}
        for name in sorted({*theirs, *ours}):
            body = name.startswith(BODIES)
            # targets of controllers and the like are kept for some modes, and weren't always
            if theirs.get(name) != ours.get(name) and (body or (name in theirs and not converted)):
                raise DatasetError(
                    "states of another scene",
                    where=f"{self.where}, {name}",
                    expected=f"{ours[name]} numbers" if name in ours else "nothing of this name",
                    found=f"{theirs[name]} numbers" if name in theirs else "nothing",
                )


def _named(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Arrays in nested dicts, each with the path that leads to it."""
    if not isinstance(node, dict):
        yield name, node
        return
    for key, inner in node.items():
        yield from _named(inner, f"{name}/{key}" if name else key)
