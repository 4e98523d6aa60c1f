"""Environment wrapper that executes actions of any convention and measures each policy step."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import CONVENTIONS, PolicySpec, TcpMotion
from robocas_ms3.evaluation.results.checkpoints import StateDeviation, flatten_state, restore_checkpoint
from robocas_ms3.evaluation.results.metrics import EpisodeMetrics
from robocas_ms3.evaluation.rollouts.weld import Weld
from robocas_ms3.planning.action_noise import draw_noise
from robocas_ms3.robots.ee_deltas import to_ee_delta_action

Stepping = Literal["timed", "upstream"]
V0_CONTROL_HZ = 5
# A policy step of RoboCAS-v0: the gripper moves until it stops, at most 5 control steps; then the
# arm moves, at most 2.
_GRIPPER_STEPS = 5
CHECKPOINT = "checkpoint"
"""Key of ``info`` with the checkpoint of each env."""
MOTION_STEPS: dict[Stepping, int] = {"timed": 1, "upstream": 2}
"""Maximum number of control steps in which an action moves the arm, by stepping."""
_STOPPED = 0.0005  # largest change in gripper width per control step, m; velocities jitter while the fingers press
_UNUSED_SIZE = 8  # pixels per side of cameras that the policy does not use; they are rendered all the same
# RoboCAS-v0's motion ends early within this distance (m) and angle (rad) of its goal, below this speed (rad/s).
_ARRIVED_DISTANCE, _ARRIVED_ANGLE, _ARRIVED_SPIN = 0.02, np.deg2rad(5), np.deg2rad(3)
_NOISE_STREAM = 413  # random stream of the action noise


class PolicyActionWrapper(gym.Wrapper):
    """Environment wrapper whose step is a policy step; it adds metrics to ``info``. For one env or a batch.

    Observations have no images; `SceneEnv.render_images` renders them on request.

    Args:
        env: a RoboCAS environment made with `make_env_kwargs`.
        spec: specification of the policy.
        stepping: ``timed``: a policy step is one control step. ``upstream``: the policy step of RoboCAS-v0. It moves
            the gripper until its width is constant, at most 1 s, then the TCP until it arrives, at most 0.4 s. In a
            batch, each env waits until all envs have finished.
        weld: whether lifted objects are fixed to the hand (`Weld`); only for one env on the CPU.
        action_noise: standard deviations of normal noise that is added to each component of each motion of the TCP, in
            mm and degrees. The noise of an episode depends on its seed only.
        checkpoints: whether ``info`` has a checkpoint (N, D) float32 of each env: state of the simulation, gripper
            command (1: open), and change of the gripper width in the last control step in m.
    """

    def __init__(
        self,
        env: gym.Env,
        spec: PolicySpec,
        stepping: Stepping,
        *,
        weld: bool = False,
        action_noise: tuple[float, float] = (0.0, 0.0),
        checkpoints: bool = False,
    ) -> None:
        super().__init__(env)
        self._observes_simulation, self._noise = spec.simulation_state, action_noise
        self._records_checkpoints = checkpoints
        self._convention, self._reference, self._stepping = CONVENTIONS[spec.convention], spec.reference, stepping
        self._base: Any = env.unwrapped
        self._base.observes_images, self._base.observes_privileged_state = False, spec.state
        count = self._base.num_envs
        bound = np.full(self._convention.size, np.inf, np.float32)
        self.single_action_space = gym.spaces.Box(-bound, bound)
        batched = np.tile(bound, (count, 1))
        self.action_space = gym.spaces.Box(-batched, batched) if count > 1 else self.single_action_space
        self.single_observation_space = self._base.single_observation_space
        self._metrics = EpisodeMetrics(self._base)
        self._weld = Weld(self._base) if weld else None
        self._open = np.ones(count, dtype=bool)  # whether the last command to each gripper was to open
        self._width_change = np.zeros(count)  # change of the gripper width in the last control step, m
        self._rngs: list[np.random.Generator] = [np.random.default_rng()] * count  # of the noise, by env

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        if self._weld:
            self._weld.reset()
        obs, info = self.env.reset(**kwargs)
        envs = (kwargs.get("options") or {}).get("env_idx", slice(None))
        self._metrics.reset(envs)
        rows = envs if isinstance(envs, slice) else np.asarray(torch.as_tensor(envs).cpu())
        self._open[rows], self._width_change[rows] = True, 0.0
        for env in np.arange(len(self._rngs))[rows]:
            self._rngs[env] = np.random.default_rng([int(self._base._episode_seed[env]), _NOISE_STREAM])
        return self._add_simulation_state(obs), {**info, **self._compute_metrics(info)}

    @property
    def is_gripper_commanded_open(self) -> bool:
        """Return whether the last gripper command of the first env was to open."""
        return bool(self._open[0])

    def get_info(self) -> dict[str, Any]:
        """Return ``info`` with the metrics of the present state; nothing is simulated."""
        info = self._base.get_info()
        return {**info, **self._compute_metrics(info)}

    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Execute one policy step: actions (A,) of one env, or (N, A) of a batch, in the convention of the policy."""
        actions = np.asarray(action.cpu() if isinstance(action, torch.Tensor) else action, np.float64)
        actions = actions.reshape(self._base.num_envs, self._convention.size)
        if not np.isfinite(actions).all():
            raise EvaluationError("NaN or infinite action", where="action", found=actions.tolist())
        obs, *others, info = self._execute(actions)
        if self._weld and not self._open[0]:
            self._weld.weld_touched_object()
        self._metrics.end_step()
        return (self._add_simulation_state(obs), *others, {**info, **self._compute_metrics(info)})

    def _execute(self, actions: np.ndarray) -> tuple:
        if self._convention.decode is None:
            self._open = actions[:, 7] > 0
            return self._step_control(actions)
        motion = self._convention.decode(actions)
        if any(self._noise):
            motion = self._add_noise(motion)
        return self._timed_step(motion) if self._stepping == "timed" else self._v0_step(motion)

    def _add_noise(self, motion: TcpMotion) -> TcpMotion:
        noise = np.concatenate([draw_noise(rng, 1, *self._noise) for rng in self._rngs])
        angles = motion.rotation.as_euler("xyz") + noise[:, 3:6]
        return TcpMotion(motion.translation + noise[:, :3], Rotation.from_euler("xyz", angles), motion.open)

    def _add_simulation_state(self, obs: Any) -> Any:
        """Add the entry ``simulation`` to an observation if the policy observes it (`policy.SimulationState`)."""
        if not self._observes_simulation:
            return obs
        values = {kind: of for kind, of in self._base.get_state_dict().items() if kind != "controller"}
        gripper = torch.from_numpy(np.where(self._open, 1.0, -1.0))
        return {**obs, "simulation": {"values": values, "gripper": gripper}}

    def _compute_metrics(self, info: dict[str, Any]) -> dict[str, torch.Tensor]:
        welds = self._weld.compute_info(info) if self._weld else {}
        checkpoint = {CHECKPOINT: self._make_checkpoint()} if self._records_checkpoints else {}
        return {**self._metrics.compute_info(), **welds, **checkpoint}

    def _make_checkpoint(self) -> torch.Tensor:
        own = torch.from_numpy(np.stack([self._open, self._width_change], axis=1).astype(np.float32))
        return torch.cat([self._base.bodies.read(), flatten_state(self._base.extra_state()), own], dim=1)

    def restore_checkpoint(self, checkpoint: np.ndarray, tolerance: float) -> tuple[StateDeviation, list[str]]:
        """Set the state of a single env to that of a checkpoint (D,) if it is far from it (`restore_checkpoint`)."""
        deviation, lost_stages = restore_checkpoint(self._base, checkpoint, tolerance)
        if "target_grasped" in lost_stages:
            self._metrics.forget_grasp()
        return deviation, lost_stages

    def _timed_step(self, motion: TcpMotion) -> tuple:
        start = self._tcp_pose() if self._reference == "tcp" else self._commanded_pose()
        return self._move_to(*_apply_motion(start, motion), motion.open)

    def _v0_step(self, motion: TcpMotion) -> tuple:
        """Execute a policy step of RoboCAS-v0: move all grippers, then all arms."""
        result, held = None, self._commanded_pose()
        turned = motion.open != self._open
        for _ in range(_GRIPPER_STEPS):
            if not (turned | (self._width_change > _STOPPED)).any():
                break
            result, turned = self._move_to(*held, motion.open), np.zeros_like(turned)
        goal = _apply_motion(self._tcp_pose() if self._reference == "tcp" else self._commanded_pose(), motion)
        for _ in range(MOTION_STEPS["upstream"]):
            result = self._move_to(*goal, motion.open)
            if self._has_arrived(*goal).all():
                break
        assert result is not None
        return result

    def _move_to(self, position: np.ndarray, rotation: Rotation, open_commands: np.ndarray) -> tuple:
        """Command one control step toward TCP poses in the frame of the arm's base: (N, 3) m and N rotations."""
        self._open = open_commands
        at, turn = self._commanded_pose()
        delta = to_ee_delta_action(turn.inv().apply(position - at), turn.inv() * rotation)
        size = np.linalg.norm(delta[:, 3:], axis=1, keepdims=True)
        delta = np.concatenate([np.clip(delta[:, :3], -1, 1), delta[:, 3:] / np.maximum(size, 1)], axis=1)
        return self._step_control(np.concatenate([delta, np.where(open_commands, 1.0, -1.0)[:, None]], axis=1))

    def _step_control(self, actions: np.ndarray) -> tuple:
        if self._weld and self._open[0]:
            self._weld.release()
        width = self._gripper_width() if self._stepping == "upstream" else 0.0
        result = self.env.step(torch.as_tensor(actions, dtype=torch.float32, device=self._base.device))
        if self._stepping == "upstream":
            self._width_change = np.abs(self._gripper_width() - width)
        self._metrics.update(self._open)
        return result

    def _tcp_pose(self) -> tuple[np.ndarray, Rotation]:
        return _to_position_and_rotation(self._base.agent.tcp_in_arm_base)

    def _commanded_pose(self) -> tuple[np.ndarray, Rotation]:
        """Return the last commanded TCP poses in the frame of the arm's base: (N, 3) m and N rotations."""
        return _to_position_and_rotation(self._base.agent.controller.controllers["arm"].reference_pose())

    def _gripper_width(self) -> np.ndarray:
        return self._base.agent.gripper_width.cpu().numpy()

    def _has_arrived(self, position: np.ndarray, rotation: Rotation) -> np.ndarray:
        at, turn = self._tcp_pose()
        spin = torch.linalg.vector_norm(self._base.agent.tcp.angular_velocity, dim=-1).cpu().numpy()
        near = np.linalg.norm(position - at, axis=1) < _ARRIVED_DISTANCE
        return near & ((turn.inv() * rotation).magnitude() < _ARRIVED_ANGLE) & (spin < _ARRIVED_SPIN)


def check_action_noise_available(spec: PolicySpec) -> None:
    """Raise `EvaluationError` if no noise can be added to actions of a policy, because they are joint targets."""
    if CONVENTIONS[spec.convention].decode is None:
        what, fix = "action noise needs motions of the TCP", "Omit --action-noise, or choose another policy."
        raise EvaluationError(
            what, where="--action-noise", expected="actions that are motions", found=spec.convention, fix=fix
        )


def choose_control_mode(convention: str) -> str:
    """Return the ManiSkill control mode for an action convention: ``pd_joint_pos`` or ``pd_ee_delta_pose``."""
    return "pd_joint_pos" if CONVENTIONS[convention].decode is None else "pd_ee_delta_pose"


def make_env_kwargs(spec: PolicySpec, rate: int, *, renders: bool = False) -> dict[str, Any]:
    """Return the keyword arguments of ``gym.make`` for the environment of a policy.

    Args:
        spec: specification of the policy.
        rate: control steps per second.
        renders: whether the caller uses ``env.render``.
    """
    common = {
        "control_mode": choose_control_mode(spec.convention),
        "reward_mode": "none",
        "sim_config": {"control_freq": rate},
        "max_episode_steps": 10**9,  # `rollout.EndConditions` ends episodes
    }
    if not spec.cameras:
        return {**common, "obs_mode": "state_dict", **({} if renders else {"render_backend": "none"})}
    modes = ["rgb", *(["depth"] if spec.depth else []), *(["state_dict"] if spec.state else [])]
    cameras = {name: {"width": width, "height": height} for name, (width, height) in spec.cameras.items()}
    others = {"width": _UNUSED_SIZE, "height": _UNUSED_SIZE}
    return {**common, "obs_mode": "+".join(modes), "sensor_configs": {**others, **cameras}}


def _to_position_and_rotation(pose: Pose) -> tuple[np.ndarray, Rotation]:
    raw = pose.raw_pose.cpu().numpy().astype(np.float64)
    return raw[:, :3], Rotation.from_quat(raw[:, [4, 5, 6, 3]])


def _apply_motion(start: tuple[np.ndarray, Rotation], motion: TcpMotion) -> tuple[np.ndarray, Rotation]:
    position, turn = start
    return position + turn.apply(motion.translation), turn * motion.rotation
