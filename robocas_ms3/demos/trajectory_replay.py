"""Replay recorded trajectories: actions, actions in another control mode, or states."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from mani_skill.envs.utils.observations import ALL_VISUAL_TEXTURES, parse_obs_mode_to_struct
from mani_skill.trajectory.utils import dict_to_list_of_dicts
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.checks import check_number
from robocas_ms3.core.errors import DatasetError, RobocasError
from robocas_ms3.core.files import make_folder
from robocas_ms3.core.output_folder import check_replaceable
from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.demos.recordings.environment import RecordedEnv, read_recorded_env
from robocas_ms3.demos.recordings.episode_recorder import EpisodeRecorder
from robocas_ms3.demos.recordings.trajectory_hdf5 import (
    BODIES,
    iterate_arrays,
    merge,
    open_episode,
    open_trajectory,
    read_steps,
)
from robocas_ms3.demos.recordings.trajectory_json import is_intervention, read_json, read_reset
from robocas_ms3.demos.settings import ReplaySettings
from robocas_ms3.robots.description_file import chain_poses
from robocas_ms3.robots.ee_controller import RoboCASEEPoseController
from robocas_ms3.robots.ee_deltas import to_ee_delta_action
from robocas_ms3.tasks.base import RoboCASEnv

_JOINT_DELTA_SCALE = 0.1  # rad at |action| = 1 of pd_joint_delta_pos
CONVERTIBLE = ("pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pose", "pd_ee_pose")
_JOINT_TARGETS = 8  # length of an action that can be converted


@dataclass(frozen=True)
class RecordedEpisode:
    """A recorded episode of S steps.

    Attributes:
        where: file and name of the episode for messages.
        seed: seed of ``env.reset``.
        options: options of ``env.reset``.
        control_mode: control mode of the actions.
        actions: (S, A) actions.
        states: S + 1 states, each an argument of ``set_state_dict``.
        is_intervention: whether the episode starts in its first recorded state instead of the state after the reset.
    """

    where: str
    seed: int
    options: dict[str, Any]
    control_mode: str
    actions: NDArray[np.float32]
    states: list[dict[str, Any]]
    is_intervention: bool

    @classmethod
    def read(cls, trajectory: Path, episode: dict[str, Any]) -> RecordedEpisode:
        """Read the episode with a JSON entry ``episode`` from a trajectory file."""
        where = f"{trajectory}, traj_{episode['episode_id']}"
        reset = read_reset(episode, where)
        with open_trajectory(trajectory) as file:
            actions, states = read_steps(open_episode(file, episode["episode_id"]), extras=True)
        return cls(where, *reset, actions, dict_to_list_of_dicts(states), is_intervention(episode))

    def check_compatible(self, env: RoboCASEnv) -> None:
        """Raise ``DatasetError`` if the actions or states have other sizes than those of the environment."""
        converted = env.control_mode != self.control_mode
        width = _JOINT_TARGETS if converted else cast(Any, env.single_action_space).shape[0]
        if self.actions.shape[1] != width:
            found = f"{self.actions.shape[1]} numbers"
            raise DatasetError(
                "actions do not fit the robot", where=self.where, expected=f"{width} numbers per action", found=found
            )
        theirs = {name: np.size(row) for name, row in iterate_arrays(self.states[0])}
        ours = {name: np.size(row.cpu().numpy()) for name, row in iterate_arrays(env.get_state_dict())}
        for name in sorted({*theirs, *ours}):
            body = name.startswith(BODIES)
            # states of controllers depend on the control mode and on the version
            if theirs.get(name) != ours.get(name) and (body or (name in theirs and not converted)):
                raise DatasetError(
                    "states do not fit the scene",
                    where=f"{self.where}, {name}",
                    expected=f"{ours[name]} numbers" if name in ours else "no such entry",
                    found=f"{theirs[name]} numbers" if name in theirs else "no such entry",
                )


@dataclass(frozen=True)
class ReplayResult:
    """Result of the replay of one episode.

    Attributes:
        episode_id: number of the episode in the replayed file.
        seed: seed of the episode.
        success: whether the task is successful at the last step.
        state_error: greatest absolute difference between a number of the final state and of the recorded final state;
            None if the actions were converted to another control mode.
    """

    episode_id: int
    seed: int
    success: bool
    state_error: float | None


def replay(settings: ReplaySettings) -> Iterator[ReplayResult]:
    """Check the settings, and return an iterator that replays one episode per result.

    Raises:
        DatasetError: the file cannot be read, or the actions cannot be converted to the control mode.
        OutputExistsError: ``save`` or its JSON file exists already.
        RobocasError: ``count`` or ``obs_mode`` is invalid.
    """
    trajectory, save = settings.file, settings.save
    if settings.count is not None:
        check_number("--count", settings.count, 1)
    _check_obs_mode(settings.obs_mode)
    data = read_json(trajectory)
    env = read_recorded_env(data["env_info"], trajectory.with_suffix(".json"), pack=settings.pack)
    recorded_mode = env.control_mode
    mode = settings.control_mode or recorded_mode
    if mode not in {*CONVERTIBLE, recorded_mode}:
        raise DatasetError(
            "unknown control mode", where="--control-mode", expected=f"one of {', '.join(CONVERTIBLE)}", found=mode
        )
    if mode != recorded_mode and (settings.use_env_states or recorded_mode != "pd_joint_pos"):
        raise DatasetError(
            "cannot convert the actions",
            where=trajectory,
            expected="a recording in pd_joint_pos, without --use-env-states",
            found=f"{recorded_mode} -> {mode}",
        )
    open_trajectory(trajectory).close()
    if save is not None:
        if save.suffix != ".h5":
            raise DatasetError("not the name of an HDF5 file", where=save, expected="a name that ends in .h5")
        if save.resolve() == trajectory.resolve():
            raise DatasetError("--save is the recording itself", where=save, fix="Choose another file name.")
        for path in (save, save.with_suffix(".json")):
            check_replaceable(path, overwrite=settings.overwrite)
    kwargs: dict[str, Any] = {"control_mode": mode, "obs_mode": settings.obs_mode}
    if settings.obs_mode == "none":
        kwargs["render_backend"] = "none"
    return _replay_all(settings, env, kwargs, data["episodes"][: settings.count])


def _check_obs_mode(mode: str) -> None:
    try:
        parse_obs_mode_to_struct(mode)
    except AssertionError as error:
        raise RobocasError(
            "unknown observation mode",
            where="--obs-mode",
            expected=f"none, state, state_dict, pointcloud, or textures joined by +: {', '.join(ALL_VISUAL_TEXTURES)}",
            found=mode,
        ) from error


def _replay_all(
    settings: ReplaySettings, recorded: RecordedEnv, kwargs: dict[str, Any], episodes: list[dict[str, Any]]
) -> Iterator[ReplayResult]:
    save = settings.save
    sources: list[Path] = []
    place = {} if save is None else {"dir": make_folder(save.parent), "prefix": f".{save.stem}.", "suffix": ".tmp"}
    with closing(recorded.make(**kwargs)) as env, tempfile.TemporaryDirectory(**place) as folder:
        for episode in episodes:
            if save is None:
                yield _replay_one(env, settings, episode)
                continue
            source = Path(folder, f"episode_{episode['episode_id']}.h5")
            recorder = EpisodeRecorder(env, source.parent, source.stem)
            result = _replay_one(recorder, settings, episode)
            if result.success or settings.allow_failure:
                recorder.finish(episode.get("robocas", {}))
                sources.append(source)
            yield result
        if save is not None and sources:
            merge(sources, save)


def _replay_one(env: gym.Env, settings: ReplaySettings, episode: dict[str, Any]) -> ReplayResult:
    base_env = env.unwrapped
    assert isinstance(base_env, RoboCASEnv)
    recorded = RecordedEpisode.read(settings.file, episode)
    _, info = env.reset(seed=recorded.seed, options=recorded.options)
    recorded.check_compatible(base_env)
    converted = base_env.control_mode != recorded.control_mode
    if isinstance(env, EpisodeRecorder) and recorded.is_intervention:
        env.start_at(recorded.states[0])
    elif settings.use_env_states or recorded.is_intervention:
        base_env.set_state_dict(recorded.states[0])
    for action, state in zip(recorded.actions, recorded.states[1:], strict=True):
        *_, info = env.step(_convert_action(action, base_env) if converted else action)
        if settings.use_env_states:
            base_env.set_state_dict(state)
    error = None if converted else compute_state_distance(cast(Any, base_env.get_state_dict()), recorded.states[-1])
    return ReplayResult(episode["episode_id"], recorded.seed, bool(info["success"][0]), error)


def _convert_action(action: np.ndarray, env: RoboCASEnv) -> np.ndarray:
    """Convert an action (8,) of ``pd_joint_pos`` to an action in the control mode of the environment.

    The result is clipped to the bounds of its control mode. ManiSkill's converter is not used, since it expects
    end-effector deltas in the root frame and measures them in the world frame.
    """
    arm, gripper, robot = action[:7].astype(float), action[7:], env.robot_spec.description
    if env.control_mode == "pd_joint_pos":
        return action
    if env.control_mode == "pd_joint_delta_pos":
        qpos = env.agent.robot.get_qpos()[0, robot.arm_slice].cpu().numpy()
        return np.append(np.clip((arm - qpos) / _JOINT_DELTA_SCALE, -1, 1), gripper).astype(np.float32)
    tcp_in_base = chain_poses(env.robot_spec.files().urdf, robot.arm_base_link, robot.tcp_link, arm[None])[0]
    if env.control_mode == "pd_ee_pose":
        euler = Rotation.from_matrix(tcp_in_base[:3, :3]).as_euler("XYZ")
        return np.concatenate([tcp_in_base[:3, 3], euler, gripper]).astype(np.float32)
    agent: Any = env.agent
    controller = agent.controller.controllers["arm"]
    assert isinstance(controller, RoboCASEEPoseController)
    motion = inverse(from_wxyz(controller.reference_pose().raw_pose[0].cpu())) @ tcp_in_base
    delta = to_ee_delta_action(motion[:3, 3], Rotation.from_matrix(motion[:3, :3]))
    return np.append(np.clip(delta, -1, 1), gripper).astype(np.float32)


def compute_state_distance(state: dict[str, Any], recorded: dict[str, Any]) -> float:
    """Return the greatest absolute difference between a number of two states of all bodies.

    The result is NaN if a state contains NaN.

    ``state`` and ``recorded`` are states in ManiSkill's format; their numbers are in m, rad, m/s and rad/s.
    """
    largest = np.float64(0.0)
    for kind in ("actors", "articulations"):
        for name, value in recorded[kind].items():
            current = state[kind][name]
            current = current.cpu().numpy() if isinstance(current, torch.Tensor) else np.asarray(current)
            largest = np.maximum(
                largest, np.abs(current.reshape(-1) - np.asarray(value).reshape(-1)).max()
            )  # max() ignores NaN
    return float(largest)
