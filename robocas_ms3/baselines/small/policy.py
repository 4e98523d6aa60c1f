"""`small` as a policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.chunks.policy import ChunkPolicy
from robocas_ms3.baselines.chunks.poses import state_of
from robocas_ms3.baselines.small.config import SmallConfig
from robocas_ms3.baselines.small.data import looked_at
from robocas_ms3.baselines.small.model import SmallModel
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.evaluation.policy import Observations, PolicySpec


def make_policy(config: SmallConfig, facts: dict[str, Any], model: SmallModel) -> ChunkPolicy:
    """A trained network as a policy, on the device that its weights are on."""
    device = next(model.parameters()).device

    def predict(seen: Observations, row: int) -> NDArray[np.floating]:
        words = seen.embeddings[row] if seen.embeddings is not None else np.zeros(384, np.float32)
        state = state_of(from_wxyz(seen.tcp_in_base[row : row + 1]), seen.gripper_width.reshape(-1)[row : row + 1])
        shown = {camera: looked_at(seen.images[camera][row], view) for camera, view in config.views.items()}
        batch = {**shown, "words": words, "state": state[0]}
        with torch.inference_mode():
            chunks = model.act({name: torch.from_numpy(value)[None].to(device) for name, value in batch.items()})
        return chunks[0].cpu().numpy()

    spec = PolicySpec(
        convention="robocas",
        reference="tcp",
        rate_hz=facts["rate_hz"],
        cameras={camera: (width, height) for camera, (width, height) in facts["pictures"].items()},  # as it learned
        language="embedding" if config.language else "none",
    )
    about = {"reopen": config.reopen}  # runs of before know nothing of it
    return ChunkPolicy(spec, predict, min(config.play, config.chunk), config.fade, about, config.reopen)
