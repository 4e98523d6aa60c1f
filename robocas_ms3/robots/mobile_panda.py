"""``robocas_mobile_panda``: a Franka Panda with lengthened finger tips on a mobile base, as a ManiSkill agent."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import (
    PDJointPosControllerConfig,
    deepcopy_dict,
)
from mani_skill.agents.registration import register_agent
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import common
from mani_skill.utils.structs import Actor, Link, Pose

from robocas_ms3.robots.combined import RobotController, State
from robocas_ms3.robots.description import MOBILE_PANDA as c
from robocas_ms3.robots.drives import EvenDrives
from robocas_ms3.robots.ee_controller import (
    BODY_FRAME,
    RoboCASEEPoseControllerConfig,
    relative_pose,
)
from robocas_ms3.robots.ee_deltas import POSITION_SCALE, ROTATION_SCALE
from robocas_ms3.robots.joint_controllers import (
    BASE_SCALE,
    JOINT_SCALE,
    FingersControllerConfig,
    HeldJointsControllerConfig,
    SmoothJointPosControllerConfig,
)
from robocas_ms3.robots.urdf import robot_files


class _GeneratedUrdf:
    """The URDF's path, on the class and on its instances; the file is generated when it is first asked for."""

    def __get__(self, instance: object, owner: type[RoboCASMobilePanda]) -> str:
        return str(robot_files(owner.finger_extension).urdf)


def _camera(
    uid: str, p: tuple[float, ...], rpy: tuple[float, ...], *, near: float, far: float, link: str | None
) -> CameraConfig:
    """640 x 480, vertical field of view 90 deg; mounted on a link, or in the world.

    The shader is the cheapest one, which matters where a CPU renders; ``sensor_configs`` of ``gym.make`` changes it.
    """
    pose = sapien.Pose(p)
    pose.set_rpy(rpy)
    return CameraConfig(uid, Pose.create(pose), 640, 480, np.pi / 2, near, far, entity_uid=link, shader_pack="minimal")


def _keyframe(arm: tuple[float, ...]) -> Keyframe:
    qpos = np.array([0.0, 0.0, 0.0, *arm, c.open_finger, c.open_finger])
    return Keyframe(pose=sapien.Pose(), qpos=qpos)


_FINGER = dict(material="gripper", patch_radius=0.1, min_patch_radius=0.1)


@register_agent()
class RoboCASMobilePanda(BaseAgent):
    """Mobile Panda. ``qpos``: base x, y, yaw, 7 arm joints, 2 fingers. The root link stands on the floor.

    Every control mode holds the base, except those ending in ``_base``, which take 3 numbers more for x, y, yaw.
    """

    uid = c.uid
    finger_extension = c.finger_extension
    urdf_path: Any = _GeneratedUrdf()
    urdf_config = dict(
        _materials=dict(
            gripper=dict(static_friction=c.finger_friction, dynamic_friction=c.finger_friction, restitution=0.0)
        ),
        link={name: _FINGER for name in c.finger_links},
    )
    keyframes = dict(rest=_keyframe(c.arm_rest), evaluation=_keyframe(c.arm_evaluation_start))

    ee_link_name = c.tcp_link
    arm_joint_names = list(c.arm_joints)
    gripper_joint_names = list(c.finger_joints)
    base_joint_names = list(c.base_joints)

    # Arm: twice as stiff as ManiSkill's Panda, damped so that no direction overshoots. Damping / stiffness is the lag.
    # Stiffer gains would track no better (targets are smooth) and press harder on what is touched.
    arm_stiffness, arm_damping, arm_force_limit = 2e3, 1.5e2, 100.0
    gripper_stiffness, gripper_damping, gripper_force_limit = 1e3, 1e2, 100.0
    base_stiffness, base_damping, base_force_limit = 4e5, 2e4, 4e3
    base_max_speed = 0.5  # m/s and rad/s

    static_camera_pose: sapien.Pose | None = None
    """World pose of ``static_camera``; none: upstream's, which looks at a table before the robot."""

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:
        arm: dict[str, Any] = dict(
            stiffness=self.arm_stiffness, damping=self.arm_damping, force_limit=self.arm_force_limit
        )
        base: dict[str, Any] = dict(
            stiffness=self.base_stiffness, damping=self.base_damping, force_limit=self.base_force_limit
        )
        end_effector: dict[str, Any] = dict(
            joint_names=self.arm_joint_names,
            ee_link=self.ee_link_name,
            urdf_path=str(robot_files(self.finger_extension).arm_urdf),
            root_link_name=c.arm_base_link,
            **arm,
        )
        arms = dict(
            pd_joint_pos=SmoothJointPosControllerConfig(self.arm_joint_names, None, None, **arm),
            pd_joint_delta_pos=PDJointPosControllerConfig(
                self.arm_joint_names, -JOINT_SCALE, JOINT_SCALE, use_delta=True, **arm
            ),
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
        mimic: dict[str, Any] = {self.gripper_joint_names[1]: {"joint": self.gripper_joint_names[0]}}
        gripper = FingersControllerConfig(
            self.gripper_joint_names,
            lower=c.finger_targets[0],
            upper=c.finger_targets[1],
            stiffness=self.gripper_stiffness,
            damping=self.gripper_damping,
            force_limit=self.gripper_force_limit,
            mimic=mimic,
        )
        held = HeldJointsControllerConfig(self.base_joint_names, **base)
        base["max_speed"] = self.base_max_speed
        moved = SmoothJointPosControllerConfig(self.base_joint_names, None, None, **base)
        moved_by = SmoothJointPosControllerConfig(
            self.base_joint_names,
            [-scale for scale in BASE_SCALE],
            BASE_SCALE,
            use_delta=True,
            normalize_action=True,
            **base,
        )
        modes = {}
        for name, controller in arms.items():
            modes[name] = dict(arm=controller, gripper=gripper, base=held)
        for name, controller in arms.items():
            modes[f"{name}_base"] = dict(arm=controller, gripper=gripper, base=moved_by if "delta" in name else moved)
        return deepcopy_dict(modes)

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        static = _camera("static_camera", (1, 1.5, 1.5), (0, np.pi / 3, -np.pi / 2), near=0.05, far=10, link=None)
        if self.static_camera_pose is not None:
            static.pose = Pose.create(self.static_camera_pose)
        return [
            _camera("base_camera", (0, -0.3, 1.2), (0, 0.43633, 0), near=0.005, far=5, link=c.base_link),
            _camera("gripper_camera", (0.05, 0, 0.05), (np.pi, -np.pi / 2, 0), near=0.001, far=5, link=c.hand_link),
            static,
        ]

    def _after_init(self) -> None:
        links: dict[str, Link] = self.robot.links_map
        self.finger1_link, self.finger2_link = (links[name] for name in c.finger_links)
        self.tcp: Link = links[self.ee_link_name]
        self.arm_base_link: Link = links[c.arm_base_link]
        self.base_link: Link = links[c.base_link]

    def reset(self, init_qpos: Any = None) -> None:
        """Stop the robot and, given a configuration, put it there, drive targets included.

        Args:
            init_qpos: (12,) or (N, 12) for the environments being reset; None leaves the robot where it is.
        """
        super().reset(init_qpos)
        self._still()
        if init_qpos is not None:
            # Otherwise steps taken before the first action would pull the robot to its former targets.
            joints = self.robot.active_joints
            targets = torch.as_tensor(init_qpos, dtype=torch.float32, device=self.device).reshape(-1, len(joints))
            self.robot.set_joint_drive_targets(targets, joints)

    def set_action(self, action: Any) -> None:
        """Hand an action (N, action size) to the controllers.

        Raises:
            ValueError: on a CPU, a number of it is NaN.
        """
        if not self.scene.gpu_sim_enabled and torch.isnan(action).any():
            raise ValueError("Action cannot be NaN. Environment received:", action)
        self.controller.set_action(action)

    def before_simulation_step(self) -> None:
        """Move on the drive targets that go from one to the next within a control step."""
        for controller in self._within_a_step:
            controller.before_simulation_step()

    def set_control_mode(self, control_mode: str | None = None) -> None:
        """Change the control mode; what the last one told the arm about its velocity is forgotten."""
        mode = control_mode or self._default_control_mode
        if mode in self.supported_control_modes and mode not in self.controllers:
            made = RobotController(self._controller_configs[mode], self.robot, self._control_freq, scene=self.scene)
            made.set_drive_property()
            self.controllers[mode] = made
            if not self.scene._gpu_sim_initialized:
                for link in self.robot.links:  # as ManiSkill does for those that it makes
                    link.disable_gravity = True
        super().set_control_mode(mode)
        self._within_a_step = [part for part in self._parts.controllers.values() if isinstance(part, EvenDrives)]
        if hasattr(self, "tcp"):  # not while the robot is being made
            self._still()
            if self.scene.gpu_sim_enabled and self.scene._gpu_sim_initialized:
                cast("Any", self.scene.px).gpu_apply_articulation_target_velocity()

    @property
    def _parts(self) -> RobotController:
        return cast("RobotController", self.controller)

    def reset_only(self, env_idx: torch.Tensor | None) -> None:
        """Say which envs the next reset of the controllers is of; None: all."""
        self._parts.reset_only = env_idx

    def controller_targets(self) -> dict[str, dict[str, torch.Tensor]]:
        """What the next actions start from, beside where the joints are; see `combined.RobotController.targets`."""
        return self._parts.targets()

    def set_controller_targets(self, state: State | None = None, env_idx: torch.Tensor | None = None) -> None:
        """Let the next actions start from targets, and where there are none from where the joints are.

        Args:
            state: of `controller_targets`, a row for each env that is set.
            env_idx: of these envs; default: all.
        """
        self._parts.set_targets(state, env_idx)

    def _still(self) -> None:
        """Take back the velocities that the drives were told, of the envs being reset."""
        joints = self.robot.active_joints
        self.robot.set_joint_drive_velocity_targets(torch.zeros(1, len(joints), device=self.device), joints)

    def get_proprioception(self) -> dict[str, Any]:
        """Joint state, TCP pose in the arm's base frame (N, 7), gripper width (N, 1), controller state."""
        obs: dict[str, Any] = dict(
            qpos=self.robot.get_qpos(),
            qvel=self.robot.get_qvel(),
            tcp_in_arm_base=self.tcp_in_arm_base.raw_pose,
            gripper_width=self.gripper_width[:, None],
        )
        state = self.controller.get_state()
        if state:
            obs["controller"] = state
        return obs

    @property
    def tcp_pose(self) -> Pose:
        """TCP in the world: z approach, y closing direction."""
        return self.tcp.pose

    @property
    def tcp_pos(self) -> torch.Tensor:
        """(N, 3) m, TCP in the world."""
        return self.tcp.pose.p

    @property
    def tcp_in_arm_base(self) -> Pose:
        """TCP in the frame of ``panda_link0``."""
        return relative_pose(self.arm_base_link, self.tcp)

    @property
    def gripper_width(self) -> torch.Tensor:
        """(N,) m, distance between the pads: the sum of both finger joints."""
        return self.robot.get_qpos()[:, c.finger_slice].sum(dim=1)

    def is_grasping(self, object: Actor, min_force: float = 0.5, max_angle: float = 85) -> torch.Tensor:
        """Say whether both fingers press on an object.

        Args:
            object: the actor.
            min_force: N, for each finger.
            max_angle: degrees between a finger's opening direction and the contact force on it.

        Returns:
            (N,) bool.
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
        """(N,) bool: no joint but the fingers moves faster than ``threshold`` (m/s, rad/s)."""
        qvel = self.robot.get_qvel()[:, : c.finger_slice.start]
        return qvel.abs().max(dim=1).values <= threshold


@register_agent()
class RoboCASMobilePandaStockFingers(RoboCASMobilePanda):
    """The same robot with ManiSkill's own fingers, for comparison."""

    uid = f"{c.uid}_stock_fingers"
    finger_extension = 0.0
