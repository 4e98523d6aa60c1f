"""`small` as a policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.chunk_policy import ChunkPolicy
from robocas_ms3.baselines.small.config import SmallConfig
from robocas_ms3.baselines.small.data import looked_at, state_of
from robocas_ms3.baselines.small.model import SmallModel
from robocas_ms3.evaluation.policy import Observations, Wants
from robocas_ms3.poses import from_wxyz


def make_policy(config: SmallConfig, facts: dict[str, Any], model: SmallModel) -> ChunkPolicy:
    """A trained network as a policy, on the device that its weights are on."""
    device = next(model.parameters()).device

    def predict(seen: Observations) -> NDArray[np.floating]:
        count = len(seen.envs)
        words = seen.embeddings if seen.embeddings is not None else np.zeros((count, 384), np.float32)
        batch = {
            camera: torch.from_numpy(np.stack([looked_at(picture, view) for picture in seen.images[camera]]))
            for camera, view in config.views.items()
        }
        state = state_of(from_wxyz(seen.tcp_in_base), seen.gripper_width.reshape(-1))
        batch |= {"state": torch.from_numpy(state), "words": torch.from_numpy(words)}
        with torch.inference_mode():
            return model.act({name: value.to(device) for name, value in batch.items()}).cpu().numpy()

    wants = Wants(
        convention="robocas",
        reference="tcp",
        rate_hz=facts["rate_hz"],
        cameras={camera: (width, height) for camera, (width, height) in facts["pictures"].items()},  # as it learned
        language="embedding" if config.language else "none",
    )
    return ChunkPolicy(wants, predict, config.play, config.fade, {})
