"""`small`: our own visuomotor policy, made to be trained on two processor cores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import OnRead, Split
from robocas_ms3.baselines.chunks import ChunkPolicy, state_of
from robocas_ms3.baselines.small.config import SmallConfig
from robocas_ms3.baselines.small.data import SmallSamples, crop_image
from robocas_ms3.baselines.small.model import SmallModel
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.evaluation.policy import Observations, PolicySpec
from robocas_ms3.robots.quantities import GRIPPER_WIDTH


class Small:
    """See `Baseline`."""

    name, version = "small", 3
    about = "base and gripper camera, language; chunks of poses by a small transformer"
    Config = SmallConfig

    def data(self, config: SmallConfig, folder: Path, split: Split, on_read: OnRead) -> SmallSamples:
        """Read the samples of a dataset with images and embeddings."""
        return SmallSamples(config, folder, split, on_read)

    def model(self, config: SmallConfig, facts: dict[str, Any]) -> SmallModel:
        """Build the network."""
        return SmallModel(config, facts)

    def policy(self, config: SmallConfig, facts: dict[str, Any], model: SmallModel) -> ChunkPolicy:
        """Return the policy, on the device of the weights."""
        device = next(model.parameters()).device

        def predict(seen: Observations, row: int) -> NDArray[np.floating]:
            words = seen.embeddings[row] if seen.embeddings is not None else np.zeros(384, np.float32)
            one = slice(row, row + 1)
            state = state_of(from_wxyz(seen.tcp_in_base[one]), seen.robot[GRIPPER_WIDTH].reshape(-1)[one])
            images = {camera: crop_image(seen.images[camera][row], view) for camera, view in config.views.items()}
            batch = {**images, "words": words, "state": state[0]}
            with torch.inference_mode():
                chunks = model.act({name: torch.from_numpy(value)[None].to(device) for name, value in batch.items()})
            return chunks[0].cpu().numpy()

        spec = PolicySpec(
            convention="robocas",
            reference="tcp",
            rate_hz=facts["rate_hz"],
            cameras={camera: (width, height) for camera, (width, height) in facts["pictures"].items()},
            language="embedding" if config.language else "none",
        )
        play, about = min(config.play, config.chunk), {"reopen": config.reopen}
        return ChunkPolicy(spec, predict, play, config.fade, config.reopen, about)


BASELINE = Small()
