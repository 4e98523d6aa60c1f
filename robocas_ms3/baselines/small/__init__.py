"""`small`: our own visuomotor policy, made to be trained on two processor cores."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Baseline
from robocas_ms3.baselines.chunks import ChunkPolicy, state_of
from robocas_ms3.baselines.small.config import SmallConfig
from robocas_ms3.baselines.small.data import SmallSamples, crop_image
from robocas_ms3.baselines.small.model import SmallModel
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.evaluation.policy import Observations, PolicySpec
from robocas_ms3.robots.quantities import GRIPPER_WIDTH


def make_policy(config: SmallConfig, facts: dict[str, Any], model: SmallModel) -> ChunkPolicy:
    """Return the policy, which acts on the device of the weights."""
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


BASELINE = Baseline("small", 3, SmallConfig, SmallModel, make_policy, SmallSamples)
