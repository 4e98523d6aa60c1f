"""`small`: our own visuomotor policy, made to be trained on two processor cores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robocas_ms3.baselines.baseline import OnRead, Split
from robocas_ms3.baselines.chunks.policy import ChunkPolicy
from robocas_ms3.baselines.small.config import SmallConfig
from robocas_ms3.baselines.small.data import SmallSamples
from robocas_ms3.baselines.small.model import SmallModel
from robocas_ms3.baselines.small.policy import make_policy


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
        """Return the policy."""
        return make_policy(config, facts, model)


BASELINE = Small()
