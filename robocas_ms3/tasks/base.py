"""What all RoboCAS environments share: a step, the state, what is in the gripper, observations."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch

from robocas_ms3.assets.pack import LoadedObject
from robocas_ms3.core.arrays import as_tensor, native, none
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.bodies import link_poses
from robocas_ms3.tasks.scene import SceneEnv


class RoboCASEnv(SceneEnv):
    """Base of the RoboCAS environments; see `SceneEnv` for its arguments.

    Attributes:
        looks: whether an observation shows what the cameras see; otherwise its pictures are black, and nothing is
            rendered.
    """

    looks = True

    # ------------------------------------------------------------------ state

    def get_state_dict(self) -> dict:
        """The state, in ManiSkill's form, from one read of all bodies, with all that what follows hangs on.

        ``controller`` holds the targets that the next actions start from (`RobotController.targets`).
        """
        return {**self.bodies.split(self.bodies.read().clone()), **self.state_beside_bodies()}

    def state_beside_bodies(self) -> dict:
        """What `get_state_dict` holds but for poses and velocities."""
        return {"controller": self.agent.controller_targets()}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state. Where it has no targets, the next action starts from where the robot is."""
        super().set_state_dict(state, cast("torch.Tensor", env_idx))
        self.agent.set_controller_targets(state.get("controller"), env_idx)

    # ------------------------------------------------------------------ step

    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """Step; see ``BaseEnv``, whose step takes longer on a CPU where neither observation nor reward is wanted.

        Raises:
            SimulationError: on a GPU PhysX ran out of memory, and has dropped contacts.
        """
        if self._engine_errors is not None:
            self._engine_errors.check()
        plain = self._obs_mode == "none" and self._reward_mode == "none" and isinstance(action, np.ndarray)
        if not plain or self.gpu_sim_enabled or action.shape != self._orig_single_action_space.shape:
            return super().step(action)
        self.agent.set_action(torch.from_numpy(action.astype(np.float32, copy=False))[None])
        self._before_control_step()
        for _ in range(self._sim_steps_per_control):
            self.agent.before_simulation_step()
            self._before_simulation_step()
            self.scene.step()
            self._after_simulation_step()
        self._after_control_step()
        self._elapsed_steps += 1
        info, self._last_obs = self.get_info(), {}
        return {}, torch.zeros(1), info["success"] | info["fail"], torch.zeros(1, dtype=torch.bool), info

    # ------------------------------------------------------------------ state

    @property
    def object_states(self) -> torch.Tensor:
        """(N, K, 13) poses of the objects, linear and angular velocities (`bodies.BODY`); don't write to it."""
        return self._objects_in(self.bodies.read())

    @property
    def object_poses(self) -> torch.Tensor:
        """(N, K, 7) poses of the objects in the world: position m, quaternion wxyz."""
        return self.object_states[..., :7].clone()

    @property
    def basket_pose(self) -> torch.Tensor:
        """(N, 7) pose of the basket in the world, where the scene has one; don't write to it."""
        return self._basket_in(self.bodies.read())

    def _objects_in(self, state: torch.Tensor) -> torch.Tensor:
        return self.bodies.of_actors(state)[:, self._object_rows]

    def _basket_in(self, state: torch.Tensor) -> torch.Tensor:
        assert self._basket_row is not None, "there is no basket in this scene"
        return self.bodies.of_actors(state)[:, self._basket_row, :7]

    def _native_basket(self, state: torch.Tensor) -> Any:
        """(N, 7) pose of the basket, native (`arrays`), from the state of all bodies; None where there is none."""
        return None if self._basket_row is None else native(self._basket_in(state))

    def centers(self, objects: Any) -> Any:
        """(N, K, 3) m, centres of mass of the objects in the world, from states (N, K, 13); native (`arrays`)."""
        return objects[..., :3] + terms.rotate(objects[..., 3:7], native(self._centers_of_mass))

    def target_center(self, objects: Any) -> Any:
        """(N, 3) m, the target's centre of mass in the world, from states (N, K, 13); native (`arrays`)."""
        slot = native(self.target_slot)
        target, center = terms.of_target(objects, slot), terms.of_target(native(self._centers_of_mass), slot)
        return target[:, :3] + terms.rotate(target[:, 3:7], center)

    def tcp_in_world(self) -> Any:
        """(N, 7) pose of the TCP in the world, native (`arrays`)."""
        return native(link_poses(self.scene, [self.agent.tcp]))[:, 0]

    def target_asset(self, env: int = 0) -> LoadedObject:
        """The target's asset in one env."""
        return self.object_assets[env][int(self.target_slot[env])]

    def gripper_forces(self) -> torch.Tensor:
        """(N, 3, K, 3) N: force of each object on left finger, right finger and hand, world frame."""
        return as_tensor(self._gripper_contacts.forces())

    def grasped(self) -> torch.Tensor:
        """(N, K) bool: which objects both fingers hold right now."""
        return as_tensor(self._grasped_by(self._gripper_contacts.forces()))

    def _grasped_by(self, forces: Any) -> Any:
        """`grasped` from the gripper's forces, both native (`arrays`)."""
        pressed = terms.pressed(forces[:, 0], forces[:, 1])
        if none(pressed):  # as most of the time: no need to ask in which direction
            return pressed
        finger = native(link_poses(self.scene, [self.agent.finger1_link]))[:, 0]
        # the left finger opens along its own +y
        opening = terms.rotate(finger[:, 3:], native(self._sideways))
        return terms.finger_grasps(forces[:, 0], forces[:, 1], opening)

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        """``tcp_pose`` (N, 7) in the world; before it, in state modes, what only a simulator knows."""
        told = self.obs_mode_struct.state or self.obs_mode_struct.state_dict
        return {**(self._privileged() if told else {}), "tcp_pose": as_tensor(self.tcp_in_world())}

    def _get_obs_sensor_data(self, apply_texture_transforms: bool = True) -> dict:
        """Pictures by camera and kind; see ``BaseEnv``."""
        last = self._last_obs.get("sensor_data") if isinstance(self._last_obs, dict) else None
        if self.looks or last is None:  # None: not of pictures, but of points made of them
            return super()._get_obs_sensor_data(apply_texture_transforms)
        return {camera: {kind: torch.zeros_like(of) for kind, of in kinds.items()} for camera, kinds in last.items()}

    def _privileged(self) -> dict[str, torch.Tensor]:
        """What only a simulator knows, (N, D) each; see docs/rl.md."""
        basket = {} if self._basket_row is None else {"basket_pose": self.basket_pose}
        return {
            "object_poses": torch.where(self.present[..., None], self.object_states[..., :7], 0.0).flatten(1),
            "target": self._is_target.float(),
            **basket,
        }
