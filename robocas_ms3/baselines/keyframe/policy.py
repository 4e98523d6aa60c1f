"""Policy with the networks of `keyframe`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.keyframe.arm_control import ArmControl, EpisodeObservation, Motion
from robocas_ms3.baselines.keyframe.camera_correction import correct_frames, estimate_corrections
from robocas_ms3.baselines.keyframe.config import KeyframeConfig
from robocas_ms3.baselines.keyframe.episode import KeyframeEpisode
from robocas_ms3.baselines.keyframe.motion import ArmPaths
from robocas_ms3.baselines.keyframe.network import KeyframeNetwork
from robocas_ms3.baselines.keyframe.perception import CameraFrame, Perception
from robocas_ms3.core.poses import Array, from_wxyz
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.quantities import GRIPPER_WIDTH
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.robots.surface import RobotSurface

_STREAM = 417  # random stream of the proposals


class KeyframePolicy:
    """Policy that views the scene, chooses the next keyframe, and moves there by inverse kinematics.

    Images are requested only for decisions. The policy knows the kinematics of the robot and the nominal calibration
    of the cameras; it uses no privileged state and no planner of the simulator.

    Args:
        config: configuration of the run.
        facts: facts of the training data.
        network: trained networks.
    """

    def __init__(self, config: KeyframeConfig, facts: dict[str, Any], network: KeyframeNetwork) -> None:
        self._settings, self._hand_camera = config.decisions, facts["hand_camera"]
        self._perception = Perception(network, config.decisions)
        self.spec = PolicySpec(
            convention="robocas",
            reference="tcp",
            rate_hz=5,
            cameras=dict.fromkeys(facts["cameras"], config.image_size),
            depth=True,
            language="embedding",
            track="modular",
        )
        self._paths: dict[str, ArmPaths] = {}  # by robot
        self._specs: dict[int, EpisodeSpec] = {}  # by env
        self._runs: dict[int, Motion] = {}  # by env, from the first action on
        self._image_requests: dict[int, bool] = {}
        self._surfaces: dict[str, RobotSurface] = {}  # by robot
        self._corrections: dict[int, dict[str, Array]] = {}  # by env: camera -> pose in its nominal pose

    def check_robot(self, robot: str) -> None:
        """Raise RobotDescriptionError or RobocasError if there is no inverse kinematics for the robot."""
        if robot not in self._paths:
            self._paths[robot] = ArmPaths(find_robot(robot))
            self._surfaces[robot] = RobotSurface(find_robot(robot))

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self.check_robot(episode.robot)
            self._specs[episode.env], self._image_requests[episode.env] = episode, True
            self._runs.pop(episode.env, None)

    def requests_images(self, envs: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (E,) bool, whether the next decision of each env needs images."""
        return np.array([self._image_requests[env] for env in envs.tolist()], dtype=bool)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return one action per env (E, 7)."""
        tcp_in_base = from_wxyz(observations.tcp_in_base)
        actions = []
        for row, env in enumerate(observations.envs.tolist()):
            frames = {}
            if self._image_requests[env]:
                frames = {camera: _select_frame(observations, camera, row) for camera in self.spec.cameras}
                if env not in self._runs:
                    surface = self._surfaces[self._specs[env].robot].compute_points(observations.qpos[row])
                    self._corrections[env] = estimate_corrections(frames, *surface)
                frames = correct_frames(frames, self._corrections[env], self._hand_camera)
            qpos = observations.qpos[row, RobotDescription.arm_slice].astype(np.float64)
            width = float(observations.robot[GRIPPER_WIDTH].reshape(-1)[row])
            observation = EpisodeObservation(tcp_in_base[row], qpos, width, frames)
            if env in self._runs:
                command = self._runs[env].send(observation)
            else:
                self._runs[env] = self._start(env, observations, row).run(observation)
                command = next(self._runs[env])
            self._image_requests[env] = command.requests_images
            actions.append(command.action)
        return np.stack(actions)

    def _start(self, env: int, observations: Observations, row: int) -> KeyframeEpisode:
        spec = self._specs[env]
        assert observations.embeddings is not None  # of language="embedding"
        return KeyframeEpisode(
            self._perception,
            ArmControl(self._paths[spec.robot], spec.motion_steps),
            self._settings,
            self._perception.read_instruction(observations.embeddings[row]),
            np.random.default_rng([spec.episode, _STREAM]),
            self._hand_camera,
        )


def _select_frame(observations: Observations, camera: str, row: int) -> CameraFrame:
    return CameraFrame(
        observations.images[camera][row],
        observations.depths[camera][row, ..., 0],
        observations.intrinsics[camera][row],
        observations.camera_in_base[camera][row],
    )
