"""`rt1`: RT-1 as the RoboCAS paper trains it (Brohan et al. 2022)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robocas_ms3.baselines.baseline import OnRead, Split
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.data import RT1Samples
from robocas_ms3.baselines.rt1.model import RT1Model
from robocas_ms3.baselines.rt1.policy import RT1Policy


class RT1:
    """See `Baseline`."""

    name, version = "rt1", 1
    about = "RT-1 of the paper: base and gripper camera, language; action tokens by a transformer"
    Config = RT1Config

    def data(self, config: RT1Config, folder: Path, split: Split, on_read: OnRead) -> RT1Samples:
        """Open a dataset with images and embeddings, whose images are read batch by batch."""
        return RT1Samples(config, folder, split, on_read)

    def model(self, config: RT1Config, facts: dict[str, Any]) -> RT1Model:
        """Build the network."""
        return RT1Model(config, facts)

    def policy(self, config: RT1Config, facts: dict[str, Any], model: RT1Model) -> RT1Policy:
        """Return the policy."""
        return RT1Policy(config, facts, model)


BASELINE = RT1()
