"""A LeRobot policy as one of ours. Runs in LeRobot's environment; knows it by its methods alone."""

from __future__ import annotations

import copy
import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.lerobot.observations import DIMENSIONS, EMBEDDING, STATE, STATE_NAMES, scaled, state_of
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.cameras import CAMERA_NAME
from robocas_ms3.robots.description import RobotDescription

_IMAGES = "observation.images."
Process = Callable[[Any], Any]


class LeRobotPolicy:
    """Asks a LeRobot policy for one action at a time and env, as LeRobot's own rollouts do.

    A LeRobot policy keeps what it saw and has yet to play in itself, of one batch of envs that begin together. Ours
    begin when they like, so each env has a copy of the policy that shares its weights and has queues of its own.

    Args:
        model: with ``reset`` and ``select_action``.
        before: LeRobot's preprocessor: one observation to a normalised batch of one.
        after: its postprocessor: an action (1, 7) back in m, rad and the gripper's opening.
        inputs: shape by key, as the checkpoint's configuration has them; pictures are (3, H, W).
        rate_hz: actions a second, the dataset's frames.
        about: what a result says of it besides.

    Raises:
        EvaluationError: the policy wants what the socket does not show.
    """

    def __init__(
        self,
        model: Any,
        before: Process,
        after: Process,
        inputs: Mapping[str, tuple[int, ...]],
        rate_hz: float,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self._model, self._before, self._after, self._about = model, before, after, dict(about or {})
        self._inputs = dict(inputs)
        cameras = {}
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
        """What a result says of it besides."""
        return self._about

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Begin episodes: queues are emptied, noise begins with the episode's seed."""
        for start in starts:
            self._models[start.env] = _copied(self._model)
            self._draws[start.env] = np.random.default_rng([start.seed, start.episode])

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7), each env by itself, so that an outcome does not depend on what is played beside it."""
        actions = [self._act(env, observations, row) for row, env in enumerate(observations.envs.tolist())]
        return np.stack(actions)

    def _act(self, env: int, observations: Observations, row: int) -> NDArray[np.float32]:
        torch.manual_seed(int(self._draws[env].integers(2**63)))  # diffusion draws noise
        with torch.inference_mode():
            action = self._after(self._models[env].select_action(self._before(self._observed(observations, row))))
        return action.reshape(-1).to("cpu", torch.float32).numpy()

    def _observed(self, observations: Observations, row: int) -> dict[str, Any]:
        """An observation as items of LeRobot's datasets have it: no axis of batches, pictures (3, H, W) from 0 to 1."""
        one = slice(row, row + 1)
        tcp = observations.tcp_in_base[one]
        joints = observations.qpos[one, RobotDescription.arm_slice]
        state = state_of(tcp[:, :3], tcp[:, [4, 5, 6, 3]], joints, observations.gripper_width[one])
        seen: dict[str, Any] = {"task": observations.instructions[row], STATE: torch.from_numpy(state[0])}
        if EMBEDDING in self._inputs:
            assert observations.embeddings is not None
            seen[EMBEDDING] = torch.from_numpy(scaled(observations.embeddings[row]))
        for camera, pictures in observations.images.items():
            picture = torch.from_numpy(np.ascontiguousarray(pictures[row]))
            seen[_IMAGES + camera] = picture.permute(2, 0, 1).float() / 255
        return {key: seen[key] for key in seen if key in self._inputs or key == "task"}


def _copied(model: Any) -> Any:
    """The same weights, with queues of its own."""
    one = copy.copy(model)
    for name, value in vars(model).items():
        if hasattr(value, "reset"):  # such as ACT's ensembler, which is no module and is reset in place
            setattr(one, name, copy.copy(value))
        elif isinstance(value, deque | dict) and name.endswith(("queue", "queues")):
            setattr(one, name, copy.deepcopy(value))
    one.reset()
    return one
