"""A LeRobot policy as one of ours; runs in LeRobot's environment, and uses nothing but the policy's methods."""

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
"""Keys of LeRobot. Its policies take what is no robot's as the environment's state; ours holds the instruction."""
STATE_NAMES = (
    *("x", "y", "z"),
    *("xx", "xy", "xz", "yx", "yy", "yz"),
    *(f"joint_{number}" for number in range(1, 8)),
    GRIPPER_WIDTH,
)
"""TCP in the arm's base, m; its x and y axes there; rad; m."""
DIMENSIONS = 384  # of an embedding
_IMAGES = "observation.images."
Processor = Callable[[Any], Any]


def state_of(position: NDArray, xyzw: NDArray, joints: NDArray, width: NDArray) -> NDArray[np.float32]:
    """Return the state (N, 17) of `STATE_NAMES`.

    Axes stand for the orientation, as the sign of the quaternion of a gripper that points down is random. The pose of
    the base is left out: the policy socket does not send it.

    Args:
        position: (N, 3) m, of the TCP in the arm's base.
        xyzw: (N, 4) its orientation there.
        joints: (N, 7) rad.
        width: (N, 1) m.
    """
    turns = Rotation.from_quat(np.asarray(xyzw, np.float64)).as_matrix()
    return np.concatenate([position, turns[:, :, 0], turns[:, :, 1], joints, width], axis=1).astype(np.float32)


def scale_embeddings(embeddings: NDArray) -> NDArray[np.float32]:
    """Scale embeddings (N, 384) so that a number of them is about 1: LeRobot does not normalise them."""
    return (np.asarray(embeddings) * np.sqrt(DIMENSIONS)).astype(np.float32)


class LeRobotPolicy:
    """Asks a LeRobot policy for one action per step and env, as LeRobot's own rollouts do.

    A LeRobot policy holds its history and the rest of its chunk itself, for one batch of envs that start together.
    Our envs start at any time, so each has a copy of the policy that shares the weights and has its own queues.

    Args:
        model: with ``reset`` and ``select_action``.
        before: LeRobot's preprocessor: one observation to a normalised batch of one.
        after: its postprocessor: an action (1, 7) back in m, rad and the gripper's opening.
        inputs: shape by key, as in the checkpoint's configuration; images are (3, H, W).
        rate_hz: actions per second.
        about: what results record about the policy.
    """

    def __init__(
        self,
        model: Any,
        before: Processor,
        after: Processor,
        inputs: Mapping[str, tuple[int, ...]],
        rate_hz: float,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self._model, self._before, self._after, self._about = model, before, after, dict(about or {})
        self._inputs, cameras = dict(inputs), {}
        for key, shape in self._inputs.items():
            if re.fullmatch(f"{_IMAGES}{CAMERA_NAME}", key) and len(shape) == 3:
                cameras[key.removeprefix(_IMAGES)] = (shape[2], shape[1])
            elif {STATE: (len(STATE_NAMES),), EMBEDDING: (DIMENSIONS,)}.get(key) != tuple(shape):
                fix = "Train on a dataset that robocas_ms3.baselines.lerobot.prepare made."
                raise EvaluationError("a policy of another dataset", where=key, found=list(shape), fix=fix)
        self.spec = PolicySpec(
            convention="robocas",
            reference="tcp",
            rate_hz=rate_hz,
            cameras=cameras,
            language="embedding" if EMBEDDING in self._inputs else "text",
        )
        self._models: dict[int, Any] = {}
        self._draws: dict[int, np.random.Generator] = {}

    def describe(self) -> dict[str, Any]:
        return self._about

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start episodes: queues are emptied, noise episodes with the episode's seed."""
        for episode in episodes:
            self._models[episode.env] = _copy_with_queues(self._model)
            self._draws[episode.env] = np.random.default_rng([episode.seed, episode.episode])

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return actions (E, 7), of each env by itself, so that they do not depend on the other envs."""
        return np.stack([self._act(env, observations, row) for row, env in enumerate(observations.envs.tolist())])

    def _act(self, env: int, observations: Observations, row: int) -> NDArray[np.float32]:
        torch.manual_seed(int(self._draws[env].integers(2**63)))  # diffusion draws noise
        with torch.inference_mode():
            action = self._after(self._models[env].select_action(self._before(self._item(observations, row))))
        return action.reshape(-1).to("cpu", torch.float32).numpy()

    def _item(self, observations: Observations, row: int) -> dict[str, Any]:
        """Return an observation like an item of LeRobot's datasets: no batch axis, images (3, H, W) from 0 to 1."""
        one = slice(row, row + 1)
        tcp = observations.tcp_in_base[one]
        joints = observations.qpos[one, RobotDescription.arm_slice]
        state = state_of(tcp[:, :3], tcp[:, [4, 5, 6, 3]], joints, observations.robot[GRIPPER_WIDTH][one])
        item: dict[str, Any] = {"task": observations.instructions[row], STATE: torch.from_numpy(state[0])}
        if EMBEDDING in self._inputs:
            assert observations.embeddings is not None
            item[EMBEDDING] = torch.from_numpy(scale_embeddings(observations.embeddings[row]))
        for camera, images in observations.images.items():
            image = torch.from_numpy(np.ascontiguousarray(images[row]))
            item[_IMAGES + camera] = image.permute(2, 0, 1).float() / 255
        return {key: item[key] for key in item if key in self._inputs or key == "task"}


def _copy_with_queues(model: Any) -> Any:
    copied = copy.copy(model)
    for name, value in vars(model).items():
        if hasattr(value, "reset"):  # such as ACT's ensembler, which is no module and is reset in place
            setattr(copied, name, copy.copy(value))
        elif isinstance(value, deque | dict) and name.endswith(("queue", "queues")):
            setattr(copied, name, copy.deepcopy(value))
    copied.reset()
    return copied
