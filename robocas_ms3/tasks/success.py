"""Stages, success and failure of the envs: what `RoboCASEnv.evaluate` returns, but for what single tasks add."""

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
from robocas_ms3.tasks.bodies import link_poses
from robocas_ms3.tasks.goals import TaskState


class SuccessCheck:
    """Checks stages, success and failure of all envs, and keeps the stages reached since the reset.

    On a CPU, the last result is returned again while nothing has moved or touches the gripper.

    Args:
        env: the `base.RoboCASEnv`, whose scene is loaded.
        stages: names, in the order of the recorded states.

    Attributes:
        reached: (stages, N) bool.
        stages: its rows by name; views, native (`arrays`).
        moment: what the last check found; the same object as before where nothing has changed since.
        target_extents: (N, 3) m, since the reset.
        surface: height of what objects stand on, m.
        fallen_below: height below which an object counts as fallen off it, m.
    """

    moment: TaskState

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
        """Forget the stages of some envs (E,), whose targets may be others."""
        self.reached[:, envs] = False
        self.target_extents = self._extents[torch.arange(len(self._extents), device=envs.device), self._env.target_slot]
        self._last = None

    def restore(self, reached: Any, envs: Any) -> None:
        """Set the stages (E, stages) of some envs; None leaves them as they are."""
        if reached is not None:
            reached = torch.as_tensor(reached, dtype=torch.bool, device=self.reached.device)
            self.reached[:, envs] = reached.reshape(-1, len(self.reached)).T
        self._last = None

    def reach(self, stage: str, now: Array) -> torch.Tensor:
        """Note which envs are at a stage now, (N,) bool, native (`arrays`); return which have reached it, (N,) bool."""
        row = self.stages[stage]
        row |= now
        return as_tensor(row).clone()

    def check(self) -> dict[str, torch.Tensor]:
        """Return stages, ``success`` and ``fail`` (N,) bool and ``disturbed`` (N,) int; don't write to them."""
        env = self._env
        state = env.bodies.read()
        forces = env.gripper_contacts.forces(env.bodies.state_except_robot)
        depends_on = self._dependencies(forces)
        if self._last is not None and depends_on is not None and self._last[0] == depends_on:
            return dict(self._last[1])
        # right after a reset the engine still reports the contacts of before
        forces = forces * to_native(env.elapsed_steps > 0)[:, None, None, None]
        found = self._check(forces, *self._objects_and_basket(state))
        self._last = self._dependencies(forces), found
        return dict(found)

    def _dependencies(self, forces: Array) -> object:
        """Return what the next result depends on, on a CPU while nothing touches the gripper; None: unknown."""
        others = self._env.bodies.state_except_robot
        return None if others is None or forces.any() else (others, self.reached.numpy().tobytes())

    def _check(self, forces: Array, objects: Array, basket: Array | None) -> dict[str, torch.Tensor]:
        """Check from forces (N, 3, K, 3), states (N, K, 13) and the basket's pose (N, 7) or None, all native."""
        env = self._env
        slot, goal = to_native(env.target_slot), env.goal
        grasped, touched = self.grasped(forces), terms.is_touched(forces)
        lifted = terms.is_lifted(objects[..., 2], to_native(env.start_poses)[..., 2], grasped)
        measures = self._measures(touched, objects, basket)
        held = terms.select_target(grasped, slot)
        now = {
            "reached_any": touched.any(1),
            "picked_any": lifted.any(1),
            "reached_target": terms.select_target(touched, slot),
            "target_grasped": held,
            "target_lifted": terms.select_target(lifted, slot),
            f"target_{goal.NAME}": measures[goal.NAME],
        }
        for stage, flags in now.items():
            if stage in self.stages:
                self.reach(stage, flags)
        success = reduce(and_, measures.values())
        if goal.REQUIRES_LIFT:
            success = self.stages["target_lifted"] & success
        fail = self._has_failed(measures, objects, basket)
        stages = dict(zip(self.stages, self.reached.clone(), strict=True))
        disturbed = self._disturbed(objects[..., :7])
        self.state = TaskState(objects, basket, held, now["reached_target"], measures[goal.NAME], disturbed, forces)
        flags = {"success": as_tensor(success), "fail": as_tensor(fail)}
        return {**stages, **flags, "disturbed": as_tensor(disturbed.sum(1))}

    def centers(self, objects: Array) -> Array:
        """Return the centres of mass (N, K, 3) of the objects in the world, from their states (N, K, 13)."""
        return objects[..., :3] + rotations.rotate(objects[..., 3:7], self._centers_of_mass)

    def target_center(self, objects: Array) -> Array:
        """Return the target's centre of mass (N, 3) in the world, from the objects' states (N, K, 13)."""
        slot = to_native(self._env.target_slot)
        target, center = terms.select_target(objects, slot), terms.select_target(self._centers_of_mass, slot)
        return target[:, :3] + rotations.rotate(target[:, 3:7], center)

    def grasped(self, forces: Array) -> Array:
        """Return which objects (N, K) both fingers hold, from forces (N, 3, K, 3) N on the gripper; native."""
        pressed = terms.is_pressed(forces[:, 0], forces[:, 1])
        if known_all_false(pressed):  # as most of the time: no need to ask in which direction
            return pressed
        finger = link_poses(self._env.scene, [self._env.agent.finger1_link])[:, 0]
        # the left finger opens along its own +y
        opening = rotations.rotate(finger[:, 3:], self._sideways)
        return terms.is_grasped(forces[:, 0], forces[:, 1], opening)

    def success_conditions(self) -> dict[str, torch.Tensor]:
        """Return what has to hold at the same moment for success, besides the lift: (N,) bool each."""
        touched = terms.is_touched(self._env.gripper_contacts.forces())
        found = self._measures(touched, *self._objects_and_basket(self._env.bodies.read()))
        return {name: as_tensor(measure) for name, measure in found.items()}

    def _objects_and_basket(self, state: torch.Tensor) -> tuple[Array, Array | None]:
        """States of the objects (N, K, 13) and pose of the basket (N, 7) or None, native, from that of all bodies."""
        basket = self._env.bodies.basket(state)
        return to_native(self._env.bodies.objects(state)), None if basket is None else to_native(basket)

    def _measures(self, touched: Array, objects: Array, basket: Array | None) -> dict[str, Array]:
        """`measures`, native, from which objects the gripper touches (N, K), their states and the basket's pose."""
        goal, slot = self._env.goal, to_native(self._env.target_slot)
        target = terms.select_target(objects, slot)
        return {
            goal.NAME: goal.is_at_goal(self.target_center(objects), basket),
            "untouched": ~terms.select_target(touched, slot),
            "at_rest": terms.is_at_rest(target[:, 7:10], target[:, 10:]),
            **goal.success_conditions(basket),
        }

    def fallen_objects(self) -> Array:
        """Return which other objects (N, K) lay 5 cm below the surface in `moment`, outside of the goal; native.

        The target is carried to the goal, and if it falls, that is ``fail``.
        """
        env, objects = self._env, self.state.objects
        low = (objects[..., 2] < self.fallen_below) & to_native(env.present & ~env.is_target)
        if known_all_false(low):  # as nearly always
            return low
        return low & ~env.goal.is_at_goal(self.centers(objects), self.state.basket)

    def _has_failed(self, measures: dict[str, Array], objects: Array, basket: Array | None) -> Array:
        """(N,) bool of ``fail``, native, from the measures, states (N, K, 13) and the basket's pose."""
        goal, slot = self._env.goal, to_native(self._env.target_slot)
        height = terms.select_target(objects[..., 2], slot)
        low, lost = height < self.fallen_below, goal.is_lost(basket, measures)
        if lost is None and known_all_false(low):  # as nearly always
            return low
        caught = goal.is_over_goal(terms.select_target(objects[..., :3], slot), basket)
        fell = terms.has_target_fallen(
            height, self.surface, low & False if caught is None else caught, ~measures["untouched"]
        )
        return fell if lost is None else fell | lost

    def _disturbed(self, poses: Array) -> Array:
        """(N, K) bool: which objects other than the target no longer stand as they stood, from poses (N, K, 7)."""
        env, undo = self._env, None
        support = env.fixtures.furniture[env.task_config.surface.furniture]
        if isinstance(support, Articulation) and env.model.support_link:
            links = [support.links_map[name] for name in (BODY, env.model.support_link)]
            body, part = link_poses(env.scene, links).swapaxes(0, 1)
            undo = terms.inverse_motion(body, part, self._support_shut)
        moved = terms.is_disturbed(poses, to_native(env.start_poses), undo) & to_native(env.present)
        return moved & (arange(moved.shape[1], moved) != to_native(env.target_slot)[:, None])
