"""Initial states of episodes as tensors, from single layouts or from a layout table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np
import torch
from mani_skill.utils.structs import Articulation, Pose
from numpy.typing import NDArray

from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.layout_table import LayoutTable, is_usable


@dataclass(frozen=True)
class InitialStates:
    """Initial states of E envs with K object slots, as tensors.

    Poses are in the world frame: position in m, quaternion wxyz.

    Attributes:
        object_poses: (E, K, 7) float32.
        robot_poses: (E, 7) poses of the robot's root link.
        basket_poses: (E, 7); NaN if the scene has no basket.
        targets: (E,) int64, slot of each target.
        present: (E, K) bool, whether each slot has an object.
    """

    object_poses: torch.Tensor
    robot_poses: torch.Tensor
    basket_poses: torch.Tensor
    targets: torch.Tensor
    present: torch.Tensor

    @classmethod
    def from_layouts(cls, layouts: Sequence[Layout], device: torch.device | str) -> InitialStates:
        """Convert E layouts to initial states on a device."""

        def to_tensor(matrices: list[NDArray[np.float64]]) -> torch.Tensor:
            return torch.from_numpy(to_wxyz(np.stack(matrices)).astype(np.float32)).to(device)

        baskets = [layout.basket_pose for layout in layouts if layout.basket_pose is not None]
        return cls(
            to_tensor([layout.object_poses for layout in layouts]),
            to_tensor([layout.robot_pose for layout in layouts]),
            to_tensor(baskets) if baskets else torch.full((len(layouts), 7), torch.nan, device=device),
            torch.tensor([layout.target for layout in layouts], device=device),
            torch.from_numpy(np.stack([layout.present for layout in layouts])).to(device),
        )

    def interleave(self, from_self: NDArray[np.bool_], others: InitialStates) -> InitialStates:
        """Merge two sets of states: row i is the next row of self if ``from_self[i]``, else of ``others``."""
        order = torch.from_numpy(np.argsort(np.argsort(~from_self, kind="stable"))).to(self.targets.device)
        return InitialStates(
            **{
                f.name: torch.cat([getattr(self, f.name), getattr(others, f.name)])[order]
                for f in fields(InitialStates)
            }
        )


class InitialStateTable:
    """All initial states of a layout table on the device, for envs that keep their objects.

    A reset selects its initial states on the device, without a copy from the host. A layout of ten objects has 0.4 kB.

    Args:
        table: layout table that has the objects of the envs.
        objects_seeds: (N,) objects seed of each env.
        device: device of the tensors.
    """

    def __init__(self, table: LayoutTable, objects_seeds: NDArray[np.int64], device: torch.device | str) -> None:
        self._table, self._objects_seeds, self._device = table, objects_seeds, device
        there = table.find_records(objects_seeds, np.zeros_like(objects_seeds))[1]
        rows, self._row_of_env = np.unique(there, return_inverse=True)
        taken = table.rows[rows]  # a copy: torch can't convert the mapped records
        names = ("object_poses", "robot_pose", "basket_pose", "target", "present")
        self._columns = [torch.from_numpy(np.ascontiguousarray(taken[name])).to(device) for name in names]

    def has_usable_layout(self, envs: NDArray[np.int64], seeds: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (E,) bool, whether the table has layouts for envs (E,) and seeds (E,), not marked unstable."""
        return is_usable(self._table.find_records(self._objects_seeds[envs], seeds)[0])

    def gather_states(self, envs: NDArray[np.int64], seeds: NDArray[np.int64]) -> InitialStates:
        """Return the initial states of envs (E,) for layout seeds (E,), which must have a usable layout."""
        columns = self._table.find_records(self._objects_seeds[envs], seeds)[2]
        row, column = (torch.from_numpy(index).to(self._device) for index in (self._row_of_env[envs], columns))
        objects, robots, baskets, targets, present = (columns[row, column] for columns in self._columns)
        return InitialStates(objects, robots, baskets, targets.long(), present)


def set_initial_states(env: Any, states: InitialStates, envs: torch.Tensor) -> None:
    """Put robot, furniture, basket and objects of envs (E,) into initial states.

    The env stores the start poses and the target.
    """
    with torch.device(env.device):
        qpos: Any = torch.as_tensor(env.agent.keyframes[env.task_config.robot_start].qpos, dtype=torch.float32)
        env.agent.reset(qpos.repeat(len(envs), 1))
        env.agent.controller.reset_only = envs
        env.agent.robot.set_pose(cast("Any", Pose.create(states.robot_poses)))
        for name, furniture in env.fixtures.furniture.items():
            if isinstance(furniture, Articulation):
                positions = env.model.joint_positions(name, opened=False)
                qpos = torch.tensor([positions.get(joint.name, 0.0) for joint in furniture.active_joints])
                furniture.set_qpos(qpos.repeat(len(envs), 1))
                furniture.set_qvel(torch.zeros(len(envs), furniture.max_dof))
        if env.fixtures.basket is not None:
            basket = Pose.create(states.basket_poses)
            env.fixtures.basket.set_pose(basket)
            env.basket_start_poses[envs] = basket.raw_pose
        if env.gpu_sim_enabled:
            env.bodies.set_object_poses(envs, states.object_poses)
        else:
            for slot, actor in enumerate(env.objects):
                actor.set_pose(Pose.create(states.object_poses[:, slot]))
        env.start_poses[envs] = states.object_poses
        env.target_slot[envs] = states.targets
        env.present[envs] = states.present
        env.is_target = torch.nn.functional.one_hot(env.target_slot, len(env.objects)).bool()
