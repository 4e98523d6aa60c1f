"""`rt1` as a policy."""

from __future__ import annotations

from collections import deque
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.model import RT1Model
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec


class RT1Policy:
    """Looks at the last six frames, the first one repeated at the start, and does what is likeliest.

    Frames are encoded once and kept as tokens, those of the language of their time. Once it says that an episode ends,
    it does the action beside that, then holds still with the gripper as it was told last.

    Pictures are asked for as the dataset stores them, and scaled as its samples are: rendering at 320 x 256 would show
    another field of view than pictures of 640 x 480 scaled to that.

    Args:
        config: of the network.
        facts: of the data it was trained on.
        model: the network, on any device.
    """

    def __init__(self, config: RT1Config, facts: dict[str, Any], model: RT1Model) -> None:
        self._config, self._model = config, model.eval()
        self._frames: dict[int, deque[torch.Tensor]] = {}  # by env, tokens (images, width), the oldest first
        self._held: dict[int, NDArray[np.float32]] = {}  # by env that has ended, the action that holds still
        self.spec = PolicySpec(
            convention="robocas",
            reference="tcp",
            rate_hz=facts["rate_hz"],
            cameras={name: (width, height) for name, (width, height) in facts["cameras"].items()},
            language="embedding",
        )

    def describe(self) -> dict[str, Any]:
        """What a result says of it: what its image encoders began with."""
        path = self._config.image_weights
        begun = path.name if path is not None and bool(self._model.from_imagenet) else "from scratch"
        return {"image_weights": begun}

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Forget what these envs showed."""
        for start in starts:
            self._frames.pop(start.env, None)
            self._held.pop(start.env, None)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7) motions and gripper commands, each env by itself: in a batch they would depend on the others' bits."""
        return np.stack([self._act(observations, row) for row in range(len(observations.envs))])

    def _act(self, observations: Observations, row: int) -> NDArray[np.floating]:
        env, count = int(observations.envs[row]), self._config.frames
        if env in self._held:
            return self._held[env]
        token = self._look(observations, row)
        frames = self._frames.setdefault(env, deque([token] * count, maxlen=count))
        frames.append(token)
        with torch.inference_mode():
            acted, over = self._model.act(torch.stack(tuple(frames))[None])
        action = acted[0].cpu().numpy()
        if over[0]:
            self._held[env] = np.append(np.zeros(6, np.float32), action[6:])
        return action

    def _look(self, observations: Observations, row: int) -> torch.Tensor:
        """(images, token_width) of what an env shows."""
        assert observations.embeddings is not None
        views = [scaled(observations.images[name][row], self._config.picture) for name in self._config.cameras]
        device = self._model.mean.device
        seen = torch.from_numpy(np.stack(views).transpose(0, 3, 1, 2)[None].copy()).to(device)
        with torch.inference_mode():
            return self._model.encode(seen, torch.from_numpy(observations.embeddings[row : row + 1]).to(device))[0]


def scaled(picture: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A picture (H, W, 3) scaled to a width and height as samples of a dataset are: down by areas."""
    if picture.shape[1::-1] == tuple(size):
        return picture
    smaller = size[0] <= picture.shape[1] and size[1] <= picture.shape[0]
    found: Any = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return found
