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
from robocas_ms3.datasets.training.torch_dataset import resize_image
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec


class RT1Policy:
    """Policy of `rt1`, which executes the most probable action.

    The network predicts the action from the last ``config.frames`` frames.

    At the start of an episode the first frame is repeated. Each frame is encoded once, with the instruction of its
    step. After an action whose terminate token is 1, the policy does not move and repeats the last gripper command.

    The evaluation renders images in the size of the dataset, and the policy scales them as the training does. Images
    rendered at 320 x 256 would have another field of view than images of 640 x 480 scaled to 320 x 256.
    """

    def __init__(self, config: RT1Config, facts: dict[str, Any], model: RT1Model) -> None:
        self._config, self._model = config, model.eval()
        self._frames: dict[int, deque[torch.Tensor]] = {}  # by env, tokens (images, width), oldest first
        self._final: dict[int, NDArray[np.float32]] = {}  # by env with a terminate token: the action without motion
        self.spec = PolicySpec(
            convention="robocas",
            reference="tcp",
            rate_hz=facts["rate_hz"],
            cameras={name: (width, height) for name, (width, height) in facts["cameras"].items()},
            language="embedding",
        )

    def describe(self) -> dict[str, Any]:
        """Return the initial weights of the image encoders, which an evaluation records in its result."""
        path = self._config.image_weights
        name = path.name if path is not None and bool(self._model.from_imagenet) else "from scratch"
        return {"image_weights": name}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._frames.pop(episode.env, None)
            self._final.pop(episode.env, None)

    def requests_images(self, envs: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (E,) bool, whether each env has no terminate token yet."""
        return np.array([env not in self._final for env in envs.tolist()], dtype=bool)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return one action per env (E, 7).

        Each env is a batch of its own, because the rounding of a row in a batch depends on the other rows.
        """
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
        views = [resize_image(observations.images[name][row], self._config.image_size) for name in self._config.cameras]
        device = self._model.mean.device
        images = torch.from_numpy(np.stack(views).transpose(0, 3, 1, 2)[None].copy()).to(device)
        with torch.inference_mode():
            return self._model.encode(images, torch.from_numpy(observations.embeddings[row : row + 1]).to(device))[0]


BASELINE = Baseline("rt1", 2, RT1Config, RT1Model, RT1Policy, RT1Samples)
