"""ManiSkill agents for an arm on a mobile base: controllers, cameras and proprioception."""

from __future__ import annotations

from typing import Any, ClassVar, cast

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import PDJointPosControllerConfig, deepcopy_dict
from mani_skill.agents.registration import register_agent
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import common, sapien_utils
from mani_skill.utils.structs import Actor, Link, Pose

from robocas_ms3.robots.cameras import CameraSpec
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.drives import InterpolatedDrives
from robocas_ms3.robots.ee_controller import BODY_FRAME, RoboCASEEPoseControllerConfig, relative_pose
from robocas_ms3.robots.ee_deltas import POSITION_SCALE, ROTATION_SCALE
from robocas_ms3.robots.joint_controllers import (
    BASE_SCALE,
    JOINT_SCALE,
    FingersControllerConfig,
    HoldJointsControllerConfig,
    JointDeltaControllerConfig,
    RobotController,
    SmoothJointPosControllerConfig,
)
from robocas_ms3.robots.quantities import QUANTITIES
from robocas_ms3.robots.registry import PANDA, STOCK_FINGERS, RobotSpec

Drive = dict[str, Any]
"""Stiffness, damping and force limit of joint drives, in ManiSkill's units."""


class _GeneratedUrdf:
    """Class attribute with the path of the robot's URDF; the first access generates the file."""

    def __get__(self, instance: object, owner: type[MobileManipulator]) -> str:
        return str(owner.spec.files().urdf)


def _keyframe(robot: RobotDescription, arm: tuple[float, ...]) -> Keyframe:
    qpos = np.array([0.0, 0.0, 0.0, *arm, robot.open_finger, robot.open_finger])
    return Keyframe(pose=sapien.Pose(), qpos=qpos)


class MobileManipulator(BaseAgent):
    """Base class of the agents: an arm on a mobile base.

    ``qpos`` has 12 values: base x, y, yaw, 7 arm joints, 2 fingers. The root link is on the floor. Control modes whose
    name ends in ``_base`` have 3 additional action dimensions for base x, y and yaw; all other modes hold the base.
    A subclass ``class MyRobot(MobileManipulator, spec=MY_SPEC)`` is registered with ManiSkill.
    """

    spec: ClassVar[RobotSpec]
    description: ClassVar[RobotDescription]
    urdf_path: Any = _GeneratedUrdf()

    # Arm: twice as stiff as ManiSkill's Panda, with enough damping not to overshoot. Stiffer gains do not track better,
    # since targets are smooth, and press harder on touched objects.
    arm_drive: ClassVar[Drive] = dict(stiffness=2e3, damping=1.5e2, force_limit=100.0)
    gripper_drive: ClassVar[Drive] = dict(stiffness=1e3, damping=1e2, force_limit=100.0)
    base_drive: ClassVar[Drive] = dict(stiffness=4e5, damping=2e4, force_limit=4e3)
    base_max_speed = 0.5  # m/s and rad/s

    cameras: tuple[CameraSpec, ...]
    """Cameras of the description; the environment replaces them by those of its task configuration."""

    def __init_subclass__(cls, spec: RobotSpec | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if spec is None:
            return
        robot = spec.description
        cls.spec, cls.description, cls.uid, cls.cameras = spec, robot, robot.uid, robot.cameras
        rubber = dict(static_friction=robot.finger_friction, dynamic_friction=robot.finger_friction, restitution=0.0)
        finger = dict(material="gripper", patch_radius=0.1, min_patch_radius=0.1)
        cls.urdf_config = dict(_materials=dict(gripper=rubber), link={name: finger for name in robot.finger_links})
        starts = dict(rest=robot.arm_rest, evaluation=robot.arm_evaluation_start)
        cls.keyframes = {name: _keyframe(robot, arm) for name, arm in starts.items()}
        register_agent()(cls)

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:
        """Control mode -> configurations of the controllers ``arm``, ``gripper`` and ``base``."""
        # ManiSkill's replay tool checks for the exact class of its own controller
        joint_deltas = JointDeltaControllerConfig if self.scene.gpu_sim_enabled else PDJointPosControllerConfig
        robot, arm, base = self.description, self.arm_drive, self.base_drive
        arm_joints, base_joints, fingers = list(robot.arm_joints), list(robot.base_joints), list(robot.finger_joints)
        end_effector: dict[str, Any] = dict(
            joint_names=arm_joints,
            ee_link=robot.tcp_link,
            urdf_path=str(self.spec.files().arm_urdf),
            root_link_name=robot.arm_base_link,
            **arm,
        )
        arms = dict(
            pd_joint_pos=SmoothJointPosControllerConfig(arm_joints, None, None, **arm),
            pd_joint_delta_pos=joint_deltas(arm_joints, -JOINT_SCALE, JOINT_SCALE, use_delta=True, **arm),
            pd_ee_delta_pose=RoboCASEEPoseControllerConfig(
                pos_lower=-POSITION_SCALE,
                pos_upper=POSITION_SCALE,
                rot_lower=-ROTATION_SCALE,
                rot_upper=ROTATION_SCALE,
                frame=BODY_FRAME,
                use_target=True,
                **end_effector,
            ),
            pd_ee_pose=RoboCASEEPoseControllerConfig(
                pos_lower=-2.0, pos_upper=2.0, use_delta=False, normalize_action=False, **end_effector
            ),
        )
        low, high = robot.finger_targets
        mimic: dict[str, Any] = {fingers[1]: {"joint": fingers[0]}}
        hand = FingersControllerConfig(fingers, lower=low, upper=high, mimic=mimic, **self.gripper_drive)
        held = HoldJointsControllerConfig(base_joints, **base)
        moving: dict[str, Any] = {**base, "max_speed": self.base_max_speed}
        base_targets = SmoothJointPosControllerConfig(base_joints, None, None, **moving)
        low_base, high_base = [-scale for scale in BASE_SCALE], list(BASE_SCALE)
        base_deltas = SmoothJointPosControllerConfig(
            base_joints, low_base, high_base, use_delta=True, normalize_action=True, **moving
        )
        modes = {name: dict(arm=controller, gripper=hand, base=held) for name, controller in arms.items()}
        for name, controller in arms.items():
            modes[f"{name}_base"] = dict(
                arm=controller, gripper=hand, base=base_deltas if "delta" in name else base_targets
            )
        return deepcopy_dict(modes)

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        return [self.camera_config(camera) for camera in self.cameras]

    def camera_config(self, camera: CameraSpec) -> CameraConfig:
        """Convert a camera specification to a ManiSkill configuration with the fastest shader.

        Values in ``sensor_configs`` of ``gym.make`` have priority over this configuration.
        """
        links = {"world": None, "base": self.description.base_link, "hand": self.description.hand_link}
        if camera.look_at is None:
            pose = sapien.Pose(camera.position)
            pose.set_rpy(camera.rpy)
        else:
            pose = sapien_utils.look_at(camera.position, camera.look_at).sp
        return CameraConfig(
            uid=camera.name,
            pose=Pose.create(pose),
            width=camera.width,
            height=camera.height,
            fov=camera.fov,
            near=camera.near,
            far=camera.far,
            entity_uid=links[camera.mount],
            shader_pack="minimal",
        )

    def _after_init(self) -> None:
        links: dict[str, Link] = self.robot.links_map
        robot = self.description
        self.finger1_link, self.finger2_link = (links[name] for name in robot.finger_links)
        self.tcp: Link = links[robot.tcp_link]
        self.hand_link: Link = links[robot.hand_link]
        self.arm_base_link: Link = links[robot.arm_base_link]
        self.base_link: Link = links[robot.base_link]

    def reset(self, init_qpos: Any = None) -> None:
        """Set all velocities to 0, and joint positions and drive targets to ``init_qpos``.

        Args:
            init_qpos: (12,) or (N, 12) joint positions, m and rad; None: keep the present positions.
        """
        super().reset(init_qpos)
        self._clear_velocity_targets()
        if init_qpos is not None:
            # Otherwise steps before the first action would move the robot to its old targets.
            joints = self.robot.active_joints
            targets = torch.as_tensor(init_qpos, dtype=torch.float32, device=self.device).reshape(-1, len(joints))
            self.robot.set_joint_drive_targets(targets, joints)

    def set_action(self, action: Any) -> None:
        if not self.scene.gpu_sim_enabled and torch.isnan(action).any():
            raise ValueError(f"action with NaN: {action.tolist()}; expected finite numbers")
        self.controller.set_action(action)

    def before_simulation_step(self) -> None:
        for controller in self._interpolated:
            controller.before_simulation_step()

    def set_control_mode(self, control_mode: str | None = None) -> None:
        """Change the control mode and clear the velocity targets of the previous one."""
        mode = control_mode or self._default_control_mode
        if mode in self.supported_control_modes and mode not in self.controllers:
            made = RobotController(self._controller_configs[mode], self.robot, self._control_freq, scene=self.scene)
            made.set_drive_property()
            self.controllers[mode] = made
            if not self.scene._gpu_sim_initialized:
                for link in self.robot.links:  # as ManiSkill does for its own controllers
                    link.disable_gravity = True
        super().set_control_mode(mode)
        self._interpolated = [
            part for part in self.controller.controllers.values() if isinstance(part, InterpolatedDrives)
        ]
        if hasattr(self, "tcp"):  # not during construction
            self._clear_velocity_targets()
            if self.scene.gpu_sim_enabled and self.scene._gpu_sim_initialized:
                cast("Any", self.scene.px).gpu_apply_articulation_target_velocity()

    @property
    def controller(self) -> RobotController:
        return cast("RobotController", super().controller)

    def _clear_velocity_targets(self) -> None:
        """Set the velocity targets of all drives to 0 in the envs that are being reset."""
        joints = self.robot.active_joints
        self.robot.set_joint_drive_velocity_targets(torch.zeros(1, len(joints), device=self.device), joints)

    def get_proprioception(self) -> dict[str, Any]:
        """Return ``obs["agent"]``: each observed quantity (N, D) by name, and ``controller``.

        The key ``controller`` is missing if the controller has no state.
        """
        obs: dict[str, Any] = {quantity.name: quantity.observe(self) for quantity in QUANTITIES if quantity.observe}
        state = self.controller.get_state()
        if state:
            obs["controller"] = state
        return obs

    @property
    def tcp_pose(self) -> Pose:
        """Pose of the TCP in the world frame. z is the approach direction, y the closing direction."""
        return self.tcp.pose

    @property
    def tcp_pos(self) -> torch.Tensor:
        return self.tcp.pose.p

    @property
    def tcp_in_arm_base(self) -> Pose:
        """Pose of the TCP in the frame of the arm's base link."""
        return relative_pose(self.arm_base_link, self.tcp)

    @property
    def gripper_width(self) -> torch.Tensor:
        """Distance (N,) in m between the finger pads: the sum of both finger joints."""
        return self.robot.get_qpos()[:, self.description.finger_slice].sum(dim=1)

    def is_grasping(self, object: Actor, min_force: float = 0.5, max_angle: float = 85) -> torch.Tensor:
        """Return for each env (N,) whether both fingers press on an object.

        Args:
            object: the object.
            min_force: least contact force of each finger, N.
            max_angle: greatest angle between contact force and opening direction of a finger, degrees.
        """
        grasping = None
        for link, side in ((self.finger1_link, 1.0), (self.finger2_link, -1.0)):
            force = self.scene.get_pairwise_contact_forces(link, object)
            opening = side * link.pose.to_transformation_matrix()[..., :3, 1]
            angle = torch.rad2deg(common.compute_angle_between(opening, force))
            pressed = (torch.linalg.norm(force, dim=1) >= min_force) & (angle <= max_angle)
            grasping = pressed if grasping is None else grasping & pressed
        assert grasping is not None
        return grasping

    def is_static(self, threshold: float = 0.2) -> torch.Tensor:
        """Return for each env (N,) whether no joint of base and arm is faster than ``threshold`` m/s or rad/s."""
        qvel = self.robot.get_qvel()[:, : self.description.finger_slice.start]
        return qvel.abs().max(dim=1).values <= threshold


class RoboCASMobilePanda(MobileManipulator, spec=PANDA):
    """A Franka Panda on a mobile base, with fingers that are 3 cm longer than ManiSkill's (default robot)."""


class RoboCASMobilePandaStockFingers(MobileManipulator, spec=STOCK_FINGERS):
    """A Franka Panda on a mobile base, with ManiSkill's standard fingers."""
