"""Lets a RoboFlamingo model act as a policy of ours, to be served over the policy socket. NumPy, no torch.

RoboFlamingo's package pins torch 2.0.1, so it is served from its own environment: ``PolicyServer`` and this module need
numpy, scipy, pydantic, PyYAML, platformdirs, msgpack, websockets and OpenCV beside it. docs/baselines_lerobot.md has
the script.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.datasets.actions import ActionScale
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec

HORIZON = 11  # frames: the paper's appendix, RoboFlamingo
PICTURES = (320, 256)  # width, height: the paper trains it on the pictures of its RT-1
STORED = (640, 480)  # as datasets hold them: 320 x 256 of these are not what a camera of 320 x 256 sees
RATE_HZ = 5.0
_BASE, _GRIPPER = "base_camera", "gripper_camera"


class WindowModel(Protocol):
    """What a policy of ours asks: a window of frames, the last of which is now."""

    def __call__(
        self, base: NDArray[np.uint8], gripper: NDArray[np.uint8], instruction: str
    ) -> NDArray[np.floating] | list[float]:
        """The action (7,), or one for each frame (11, 7), of which the last is played.

        Args:
            base: (11, H, W, 3) of the base camera.
            gripper: (11, H, W, 3) of the gripper's.
            instruction: what is asked.

        Returns:
            Position and Euler angles, -1 to 1 over the dataset's ranges; the gripper's opening, 0 to 1.
        """
        ...


class StepModel(Protocol):
    """What RoboFlamingo's ``ModelWrapper`` is to CALVIN's evaluation: one frame at a time, kept in the model itself."""

    def reset(self) -> None:
        """Forget the frames."""
        ...

    def step(self, obs: dict[str, Any], goal: str) -> Any:
        """(7,) numbers -1 to 1, the gripper's -1 closed or 1 open.

        Args:
            obs: ``{"rgb_obs": {"rgb_static", "rgb_gripper"}}``, (H, W, 3) uint8 each.
            goal: the instruction.
        """
        ...


class Stepwise:
    """A model that goes frame by frame, asked about windows: it forgets, and is shown the window again.

    So one model plays several envs, and nothing of one episode is left in another, at the price of 11 steps of the
    model for one of the robot's.

    Args:
        model: with ``use_state`` and ``tcp_rel`` off, as no robot's state is told, and actions are the TCP's own here.
    """

    def __init__(self, model: StepModel) -> None:
        self._model = model

    def __call__(self, base: NDArray[np.uint8], gripper: NDArray[np.uint8], instruction: str) -> NDArray[np.floating]:
        """(7,) of the last frame; see `WindowModel`."""
        self._model.reset()
        said: Any = None
        for static, hand in zip(base, gripper, strict=True):
            said = self._model.step({"rgb_obs": {"rgb_static": static, "rgb_gripper": hand}}, instruction)
        action = np.asarray(said, np.float64)
        return np.append(action[..., :6], (action[..., 6:] + 1) / 2)


class RoboFlamingoPolicy:
    """The policy: keeps the last 11 frames of each env, the first one repeated before there are as many.

    Args:
        model: that is asked.
        scale: ranges of the dataset that it was trained on, `scale_of`.
        pictures: (width, height) in pixels that the model is shown, whole pictures squeezed.
        stored: (width, height) in pixels of the dataset that it was trained on.
        rate_hz: actions a second, the dataset's.
    """

    def __init__(
        self,
        model: WindowModel,
        scale: ActionScale,
        pictures: tuple[int, int] = PICTURES,
        stored: tuple[int, int] = STORED,
        rate_hz: float = RATE_HZ,
    ) -> None:
        self._model, self._scale, self._pictures = model, scale, pictures
        cameras = {_BASE: stored, _GRIPPER: stored}
        self.spec = PolicySpec(convention="robocas", reference="tcp", rate_hz=rate_hz, cameras=cameras)
        self._frames: dict[int, deque[tuple[NDArray[np.uint8], NDArray[np.uint8]]]] = {}

    def describe(self) -> dict[str, Any]:
        """What a result says of it besides."""
        ranges = {"low": self._scale.low.tolist(), "high": self._scale.high.tolist()}
        return {"model": type(self._model).__qualname__, "horizon": HORIZON, "ranges": ranges}

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Begin episodes; the frames of these envs are forgotten, those of others are not."""
        for start in starts:
            self._frames[start.env] = deque(maxlen=HORIZON)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7) of the convention ``robocas``.

        Raises:
            EvaluationError: the model says what is no action.
        """
        return np.stack([self._act(env, observations, row) for row, env in enumerate(observations.envs.tolist())])

    def _act(self, env: int, observations: Observations, row: int) -> NDArray[np.float32]:
        frames, images = self._frames[env], observations.images
        now = self._squeezed(images[_BASE][row]), self._squeezed(images[_GRIPPER][row])
        frames.extend([now] if frames else [now] * HORIZON)
        base, gripper = (np.stack(pictures) for pictures in zip(*frames, strict=True))
        action = np.asarray(self._model(base, gripper, observations.instructions[row]), np.float64)
        if action.shape == (HORIZON, 7):
            action = action[-1]
        if action.shape != (7,) or not np.isfinite(action).all():
            expected = f"7 numbers, or {HORIZON} times 7"
            raise EvaluationError("no action of RoboFlamingo", expected=expected, found=action.tolist())
        return self._scale.decode(np.append(np.clip(action[:6], -1, 1), np.clip(action[6:], 0, 1)))

    def _squeezed(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture as the model knows them, in memory of its own: down by areas, as samples of a dataset are."""
        if picture.shape[1::-1] == self._pictures:
            return picture.copy()
        found: Any = cv2.resize(picture, self._pictures, interpolation=cv2.INTER_AREA)
        return found


def scale_of(data_info: Path) -> ActionScale:
    """Ranges of ``action_space`` in the dataset's ``data_info.json``: 1st to 99th percentile of each axis, m and rad.

    Raises:
        EvaluationError: there is no such file.
        DatasetError: it has no ranges.
    """
    try:
        info = load_json(data_info)
    except (OSError, ValueError) as error:
        raise EvaluationError("no data_info.json of a RoboCAS dataset", where=data_info, found=error) from error
    return ActionScale.of(info.get("action_space", {}) if isinstance(info, dict) else {}, where=data_info)
