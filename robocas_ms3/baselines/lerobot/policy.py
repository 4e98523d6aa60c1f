"""Adapter that makes a LeRobot policy a `Policy`.

It runs in LeRobot's Python environment, but does not import LeRobot.
"""

from __future__ import annotations

import copy
import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.cameras import CAMERA_NAME
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.quantities import GRIPPER_WIDTH, STATE

EMBEDDING, ACTION = "observation.environment_state", "action"
"""LeRobot's keys. The embedding of the instruction is stored as the state of the environment."""
STATE_NAMES = (
    *("x", "y", "z"),
    *("xx", "xy", "xz", "yx", "yy", "yz"),
    *(f"joint_{number}" for number in range(1, 8)),
    GRIPPER_WIDTH,
)
"""TCP position in the arm's base frame, m; its x and y axes there; joints, rad; gripper width, m."""
DIMENSIONS = 384  # size of an embedding
_IMAGES = "observation.images."
Processor = Callable[[Any], Any]


def make_state(position: NDArray, xyzw: NDArray, joints: NDArray, width: NDArray) -> NDArray[np.float32]:
    """Return the states (N, 17) that LeRobot policies observe; `STATE_NAMES` names the values.

    The x and y axes represent the orientation of the TCP, because the sign of a quaternion of a gripper that points
    down is random. The pose of the robot's base is not included, because the policy socket does not send it.

    Args:
        position: (N, 3) TCP position in the arm's base frame, m.
        xyzw: (N, 4) TCP orientation in the arm's base frame, quaternion.
        joints: (N, 7) joint positions of the arm, rad.
        width: (N, 1) gripper width, m.
    """
    axes = Rotation.from_quat(np.asarray(xyzw, np.float64)).as_matrix()
    return np.concatenate([position, axes[:, :, 0], axes[:, :, 1], joints, width], axis=1).astype(np.float32)


def scale_embeddings(embeddings: NDArray) -> NDArray[np.float32]:
    """Scale unit embeddings (N, 384) to components of about 1, because LeRobot does not normalise them."""
    return (np.asarray(embeddings) * np.sqrt(DIMENSIONS)).astype(np.float32)


class LeRobotPolicy:
    """Policy that calls ``select_action`` of a LeRobot policy once per step and env.

    A LeRobot policy stores past observations and the rest of a chunk, for a batch of envs that start together. The envs
    of an evaluation start at different times. Therefore each env has a copy of the policy with its own queues and the
    same weights.

    Args:
        model: LeRobot policy, with ``reset`` and ``select_action``.
        preprocessor: LeRobot's preprocessor, which makes a normalised batch of one observation.
        postprocessor: LeRobot's postprocessor, which makes an action (1, 7) in m, rad and gripper command.
        inputs: shape of each input by its LeRobot key, from the checkpoint's configuration; images are (3, H, W).
        rate_hz: actions per second.
        description: return value of `describe`.

    Raises:
        EvaluationError: the inputs are not those of a dataset that `prepare_dataset` wrote.
    """

    def __init__(
        self,
        model: Any,
        preprocessor: Processor,
        postprocessor: Processor,
        inputs: Mapping[str, tuple[int, ...]],
        rate_hz: float,
        description: Mapping[str, Any] | None = None,
    ) -> None:
        self._model, self._preprocessor, self._postprocessor = model, preprocessor, postprocessor
        self._description = dict(description or {})
        self._inputs, cameras = dict(inputs), {}
        for key, shape in self._inputs.items():
            if re.fullmatch(f"{_IMAGES}{CAMERA_NAME}", key) and len(shape) == 3:
                cameras[key.removeprefix(_IMAGES)] = (shape[2], shape[1])
            elif {STATE: (len(STATE_NAMES),), EMBEDDING: (DIMENSIONS,)}.get(key) != tuple(shape):
                fix = "Train on a dataset written by `python -m robocas_ms3.baselines.lerobot.prepare`."
                raise EvaluationError(
                    "unexpected input of the LeRobot policy",
                    where=key,
                    expected=f"{_IMAGES}CAMERA (3, H, W), {STATE} ({len(STATE_NAMES)},) or {EMBEDDING} ({DIMENSIONS},)",
                    found=f"shape {tuple(shape)}",
                    fix=fix,
                )
        self.spec = PolicySpec(
            convention="robocas",
            reference="tcp",
            rate_hz=rate_hz,
            cameras=cameras,
            language="embedding" if EMBEDDING in self._inputs else "text",
        )
        self._models: dict[int, Any] = {}
        self._generators: dict[int, np.random.Generator] = {}

    def describe(self) -> dict[str, Any]:
        return self._description

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start episodes: empty the queues of their envs, and seed the noise with the episodes' seeds."""
        for episode in episodes:
            self._models[episode.env] = _copy_with_queues(self._model)
            self._generators[episode.env] = np.random.default_rng([episode.seed, episode.episode])

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return one action per env (E, 7).

        Each env is a batch of its own, so the envs do not influence each other.
        """
        return np.stack([self._act(env, observations, row) for row, env in enumerate(observations.envs.tolist())])

    def _act(self, env: int, observations: Observations, row: int) -> NDArray[np.float32]:
        torch.manual_seed(int(self._generators[env].integers(2**63)))  # for the noise of diffusion policies
        with torch.inference_mode():
            action = self._postprocessor(
                self._models[env].select_action(self._preprocessor(self._make_item(observations, row)))
            )
        return action.reshape(-1).to("cpu", torch.float32).numpy()

    def _make_item(self, observations: Observations, row: int) -> dict[str, Any]:
        """Return the observation of a row as an item of a LeRobot dataset.

        The item has no batch axis. Images are (3, H, W) in 0..1.
        """
        one = slice(row, row + 1)
        tcp = observations.tcp_in_base[one]
        joints = observations.qpos[one, RobotDescription.arm_slice]
        state = make_state(tcp[:, :3], tcp[:, [4, 5, 6, 3]], joints, observations.robot[GRIPPER_WIDTH][one])
        item: dict[str, Any] = {"task": observations.instructions[row], STATE: torch.from_numpy(state[0])}
        if EMBEDDING in self._inputs:
            assert observations.embeddings is not None
            item[EMBEDDING] = torch.from_numpy(scale_embeddings(observations.embeddings[row]))
        for camera, images in observations.images.items():
            image = torch.from_numpy(np.ascontiguousarray(images[row]))
            item[_IMAGES + camera] = image.permute(2, 0, 1).float() / 255
        return {key: item[key] for key in item if key in self._inputs or key == "task"}


def _copy_with_queues(model: Any) -> Any:
    """Return a LeRobot policy with the same weights and its own empty queues."""
    copied = copy.copy(model)
    for name, value in vars(model).items():
        if hasattr(value, "reset"):  # such as ACT's temporal ensembler, which is reset in place
            setattr(copied, name, copy.copy(value))
        elif isinstance(value, deque | dict) and name.endswith(("queue", "queues")):
            setattr(copied, name, copy.deepcopy(value))
    copied.reset()
    return copied
