"""Stages, success and failure of the envs, as returned by `RoboCASEnv.evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import and_
from typing import Any

import torch
from mani_skill.utils.structs import Articulation

from robocas_ms3.assets.manifest import BODY
from robocas_ms3.core import rotations
from robocas_ms3.core.arrays import Array, arange, as_tensor, known_all_false, to_native
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.bodies import read_link_poses
from robocas_ms3.tasks.goals import TaskState


class SuccessCheck:
    """Check of stages, success and failure of all envs; stores the stages reached since the reset.

    On a CPU, the last result is reused while no object moves and no object touches the gripper.

    Args:
        env: the `base.RoboCASEnv`, with a loaded scene.
        stages: names of the stages, in the order in which states store them.

    Attributes:
        reached: (stages, N) bool, whether each stage was reached since the reset.
        stages: (N,) rows of ``reached`` by stage name; views, native arrays (`core.arrays`).
        state: `TaskState` of the last check; a new object only if the result was computed again.
        target_extents: (N, 3) size of the target's bounding box in its own frame, m.
        surface: height of the surface on which objects stand, world frame, m.
        fallen_below: height below which an object counts as fallen off the surface, world frame, m.
    """

    state: TaskState

    def __init__(self, env: Any, stages: Sequence[str]) -> None:
        self._env = env
        self.reached = torch.zeros(len(stages), env.num_envs, dtype=torch.bool, device=env.device)
        self.stages = dict(zip(stages, to_native(self.reached), strict=True))
        self._last: tuple[object, dict[str, torch.Tensor]] | None = None
        shut = env.model.support_motion(opened=False)
        self._support_shut = to_native(torch.as_tensor(shut, dtype=torch.float32, device=env.device))
        facts = [[asset.asset for asset in row] for row in env.object_assets]
        centers = [[fact.center_of_mass for fact in row] for row in facts]
        self._centers_of_mass = to_native(torch.tensor(centers, dtype=torch.float32, device=env.device))
        extents = [[fact.extents for fact in row] for row in facts]
        self._extents = torch.tensor(extents, dtype=torch.float32, device=env.device)
        self.target_extents = self._extents[:, 0]
        self._sideways = to_native(torch.tensor([[0.0, 1.0, 0.0]], device=env.device))
        self.surface = float(env.model.support_pose[2, 3]) + env.model.region.z
        self.fallen_below = self.surface - terms.FALLEN

    def reset(self, envs: torch.Tensor) -> None:
        """Start an episode in envs (E,): clear the reached stages, and read the size of the new target."""
        self.reached[:, envs] = False
        self.target_extents = self._extents[torch.arange(len(self._extents), device=envs.device), self._env.target_slot]
        self._last = None

    def restore_stages(self, reached: Any, envs: Any) -> None:
        """Set the reached stages (E, stages) bool of some envs, from a state; None leaves them unchanged."""
        if reached is not None:
            reached = torch.as_tensor(reached, dtype=torch.bool, device=self.reached.device)
            self.reached[:, envs] = reached.reshape(-1, len(self.reached)).T
        self._last = None

    def mark_reached(self, stage: str, is_reached: Array) -> torch.Tensor:
        """Mark a stage as reached in envs where ``is_reached`` (N,) is true; return all its flags (N,) bool."""
        row = self.stages[stage]
        row |= is_reached
        return as_tensor(row).clone()

    def check(self) -> dict[str, torch.Tensor]:
        """Return stages, ``success`` and ``fail`` (N,) bool, and ``disturbed`` (N,) int; read only."""
        env = self._env
        state = env.bodies.read()
        forces = env.gripper_contacts.read_forces(env.bodies.state_except_robot)
        depends_on = self._reuse_key(forces)
        if self._last is not None and depends_on is not None and self._last[0] == depends_on:
            return dict(self._last[1])
        # directly after a reset the engine still reports the contacts of the last episode
        forces = forces * to_native(env.elapsed_steps > 0)[:, None, None, None]
        found = self._compute_result(forces, *self._objects_and_basket(state))
        self._last = self._reuse_key(forces), found
        return dict(found)

    def _reuse_key(self, forces: Array) -> object:
        """Return a value that determines the result; None: compute it (GPU, or gripper contact)."""
        others = self._env.bodies.state_except_robot
        return None if others is None or forces.any() else (others, self.reached.numpy().tobytes())

    def _compute_result(self, forces: Array, objects: Array, basket: Array | None) -> dict[str, torch.Tensor]:
        """Compute the result of `check`, and set `state`; all arguments are native arrays.

        Args:
            forces: (N, 3, K, 3) force of each object on left finger, right finger and hand; newtons, world frame.
            objects: (N, K, 13) states of the objects.
            basket: (N, 7) pose of the basket, or None.
        """
        env = self._env
        slot, goal = to_native(env.target_slot), env.goal
        grasped, touched = self.is_object_grasped(forces), terms.is_touched(forces)
        lifted = terms.is_lifted(objects[..., 2], to_native(env.start_poses)[..., 2], grasped)
        conditions = self._compute_conditions(touched, objects, basket)
        held = terms.select_target(grasped, slot)
        now = {
            "reached_any": touched.any(1),
            "picked_any": lifted.any(1),
            "reached_target": terms.select_target(touched, slot),
            "target_grasped": held,
            "target_lifted": terms.select_target(lifted, slot),
            f"target_{goal.NAME}": conditions[goal.NAME],
        }
        for stage, flags in now.items():
            if stage in self.stages:
                self.mark_reached(stage, flags)
        success = reduce(and_, conditions.values())
        if goal.REQUIRES_LIFT:
            success = self.stages["target_lifted"] & success
        fail = self._has_failed(conditions, objects, basket)
        stages = dict(zip(self.stages, self.reached.clone(), strict=True))
        disturbed = self._is_disturbed(objects[..., :7])
        self.state = TaskState(objects, basket, held, now["reached_target"], conditions[goal.NAME], disturbed, forces)
        flags = {"success": as_tensor(success), "fail": as_tensor(fail)}
        return {**stages, **flags, "disturbed": as_tensor(disturbed.sum(1))}

    def centers_of_mass(self, object_states: Array) -> Array:
        """Return the centres of mass (N, K, 3) of the objects, world frame, from their states (N, K, 13)."""
        return object_states[..., :3] + rotations.rotate(object_states[..., 3:7], self._centers_of_mass)

    def target_center(self, object_states: Array) -> Array:
        """Return the target's centre of mass (N, 3), world frame, from the states (N, K, 13) of all objects."""
        slot = to_native(self._env.target_slot)
        target = terms.select_target(object_states, slot)
        center = terms.select_target(self._centers_of_mass, slot)
        return target[:, :3] + rotations.rotate(target[:, 3:7], center)

    def is_object_grasped(self, forces: Array) -> Array:
        """Return (N, K) bool, whether both fingers hold each object, from gripper forces (N, 3, K, 3)."""
        pressed = terms.presses_both_fingers(forces[:, 0], forces[:, 1])
        if known_all_false(pressed):  # the usual case: the directions need not be checked
            return pressed
        finger = read_link_poses(self._env.scene, [self._env.agent.finger1_link])[:, 0]
        # the left finger opens along its own +y
        opening = rotations.rotate(finger[:, 3:], self._sideways)
        apart = to_native(self._env.agent.gripper_width) >= terms.MIN_GRASP_WIDTH
        return terms.is_grasped(forces[:, 0], forces[:, 1], opening) & apart[:, None]

    def success_conditions(self) -> dict[str, torch.Tensor]:
        """Return the success conditions by name, (N,) bool each.

        These must hold at the same time. The lift is not one of them, because it must only have happened before.
        """
        touched = terms.is_touched(self._env.gripper_contacts.read_forces())
        found = self._compute_conditions(touched, *self._objects_and_basket(self._env.bodies.read()))
        return {name: as_tensor(measure) for name, measure in found.items()}

    def _objects_and_basket(self, state: torch.Tensor) -> tuple[Array, Array | None]:
        """Return native object states (N, K, 13) and basket pose (N, 7), or None, from the flat state (N, D)."""
        basket = self._env.bodies.basket_pose(state)
        return to_native(self._env.bodies.object_states(state)), None if basket is None else to_native(basket)

    def _compute_conditions(self, touched: Array, objects: Array, basket: Array | None) -> dict[str, Array]:
        """Return `success_conditions` as native arrays.

        Args:
            touched: (N, K) bool, whether the gripper touches each object.
            objects: (N, K, 13) states of the objects.
            basket: (N, 7) pose of the basket, or None.
        """
        goal, slot = self._env.goal, to_native(self._env.target_slot)
        target = terms.select_target(objects, slot)
        return {
            goal.NAME: goal.is_at_goal(self.target_center(objects), basket),
            "untouched": ~terms.select_target(touched, slot),
            "at_rest": terms.is_at_rest(target[:, 7:10], target[:, 10:]),
            **goal.success_conditions(basket),
        }

    def fallen_objects(self) -> Array:
        """Return (N, K) bool, whether each object, except the target, has fallen off the surface; native.

        In `state` its origin is more than 5 cm below the surface, and it is not at the goal. The fall of the target is
        ``fail``.
        """
        env, objects = self._env, self.state.object_states
        low = (objects[..., 2] < self.fallen_below) & to_native(env.present & ~env.is_target)
        if known_all_false(low):  # the usual case
            return low
        return low & ~env.goal.is_at_goal(self.centers_of_mass(objects), self.state.basket_pose)

    def _has_failed(self, conditions: dict[str, Array], objects: Array, basket: Array | None) -> Array:
        """Return ``fail`` (N,) bool: the target has fallen, or the goal can't be reached any more."""
        goal, slot = self._env.goal, to_native(self._env.target_slot)
        height = terms.select_target(objects[..., 2], slot)
        low, lost = height < self.fallen_below, goal.is_success_impossible(basket, conditions)
        if lost is None and known_all_false(low):  # the usual case
            return low
        caught = goal.is_above_goal(terms.select_target(objects[..., :3], slot), basket)
        fell = terms.has_target_fallen(
            height, self.surface, low & False if caught is None else caught, ~conditions["untouched"]
        )
        return fell if lost is None else fell | lost

    def _is_disturbed(self, poses: Array) -> Array:
        """Return (N, K) bool, whether each object, except the target, is disturbed, from poses (N, K, 7)."""
        env, undo = self._env, None
        support = env.fixtures.furniture[env.task_config.surface.furniture]
        if isinstance(support, Articulation) and env.model.support_link:
            links = [support.links_map[name] for name in (BODY, env.model.support_link)]
            body, part = read_link_poses(env.scene, links).swapaxes(0, 1)
            undo = terms.inverse_part_motion(body, part, self._support_shut)
        moved = terms.is_disturbed(poses, to_native(env.start_poses), undo) & to_native(env.present)
        return moved & (arange(moved.shape[1], moved) != to_native(env.target_slot)[:, None])
