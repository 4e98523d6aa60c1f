"""`rt1`: RT-1 as the RoboCAS paper trains it (Brohan et al. 2022)."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Baseline
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.data import RT1Samples
from robocas_ms3.baselines.rt1.model import RT1Model
from robocas_ms3.datasets.training.torch_dataset import resize
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec


class RT1Policy:
    """Takes the likeliest action for the last six frames, the first one repeated at the start.

    Frames are encoded once and kept as tokens, with the language of their time. After an action that ends the episode
    the policy does nothing, with the last gripper command.

    Images are requested as the dataset stores them, and scaled as its samples are: images rendered at 320 x 256 would
    show another field of view than images of 640 x 480 scaled to that.
    """

    def __init__(self, config: RT1Config, facts: dict[str, Any], model: RT1Model) -> None:
        self._config, self._model = config, model.eval()
        self._frames: dict[int, deque[torch.Tensor]] = {}  # by env, tokens (images, width), the oldest first
        self._final: dict[int, NDArray[np.float32]] = {}  # by env that has ended, the action that does nothing
        self.spec = PolicySpec(
            convention="robocas",
            reference="tcp",
            rate_hz=facts["rate_hz"],
            cameras={name: (width, height) for name, (width, height) in facts["cameras"].items()},
            language="embedding",
        )

    def describe(self) -> dict[str, Any]:
        """Return what results record about the policy: the initial weights of its image encoders."""
        path = self._config.image_weights
        name = path.name if path is not None and bool(self._model.from_imagenet) else "from scratch"
        return {"image_weights": name}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._frames.pop(episode.env, None)
            self._final.pop(episode.env, None)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return actions (E, 7), of each env by itself: in a batch their last bits depend on the other rows."""
        return np.stack([self._act(observations, row) for row in range(len(observations.envs))])

    def _act(self, observations: Observations, row: int) -> NDArray[np.floating]:
        env, count = int(observations.envs[row]), self._config.frames
        if env in self._final:
            return self._final[env]
        token = self._encode(observations, row)
        frames = self._frames.setdefault(env, deque([token] * count, maxlen=count))
        frames.append(token)
        with torch.inference_mode():
            actions, is_last = self._model.act(torch.stack(tuple(frames))[None])
        action = actions[0].cpu().numpy()
        if is_last[0]:
            self._final[env] = np.append(np.zeros(6, np.float32), action[6:])
        return action

    def _encode(self, observations: Observations, row: int) -> torch.Tensor:
        assert observations.embeddings is not None
        views = [resize(observations.images[name][row], self._config.image) for name in self._config.cameras]
        device = self._model.mean.device
        images = torch.from_numpy(np.stack(views).transpose(0, 3, 1, 2)[None].copy()).to(device)
        with torch.inference_mode():
            return self._model.encode(images, torch.from_numpy(observations.embeddings[row : row + 1]).to(device))[0]


BASELINE = Baseline("rt1", 1, RT1Config, RT1Model, RT1Policy, RT1Samples)
