"""`small`: a visuomotor policy with 1.9 M parameters that trains on two CPU cores."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Baseline
from robocas_ms3.baselines.chunks import ChunkPolicy, encode_proprioception
from robocas_ms3.baselines.small.config import SmallConfig
from robocas_ms3.baselines.small.data import SmallSamples, crop_image
from robocas_ms3.baselines.small.model import SmallModel
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.evaluation.policy import Observations, PolicySpec
from robocas_ms3.robots.quantities import GRIPPER_WIDTH


def make_policy(config: SmallConfig, facts: dict[str, Any], model: SmallModel) -> ChunkPolicy:
    """Make the policy of a trained network; it runs on the device of the weights."""
    device = next(model.parameters()).device

    def predict(observations: Observations, row: int) -> NDArray[np.floating]:
        text = observations.embeddings[row] if observations.embeddings is not None else np.zeros(384, np.float32)
        one = slice(row, row + 1)
        state = encode_proprioception(
            from_wxyz(observations.tcp_in_base[one]), observations.robot[GRIPPER_WIDTH].reshape(-1)[one]
        )
        images = {camera: crop_image(observations.images[camera][row], view) for camera, view in config.views.items()}
        batch = {**images, "text": text, "state": state[0]}
        with torch.inference_mode():
            chunks = model.act({name: torch.from_numpy(value)[None].to(device) for name, value in batch.items()})
        return chunks[0].cpu().numpy()

    spec = PolicySpec(
        convention="robocas",
        reference="tcp",
        rate_hz=facts["rate_hz"],
        cameras={camera: (width, height) for camera, (width, height) in facts["image_sizes"].items()},
        language="embedding" if config.language else "none",
    )
    n_action_steps, description = min(config.n_action_steps, config.chunk), {"reopen": config.reopen}
    return ChunkPolicy(spec, predict, n_action_steps, config.temporal_ensemble_coeff, config.reopen, description)


BASELINE = Baseline("small", 4, SmallConfig, SmallModel, make_policy, SmallSamples)
