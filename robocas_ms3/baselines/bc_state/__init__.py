"""`bc-state`: chunks of poses from the privileged state of the simulator, an upper bound without vision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import OnRead, Split
from robocas_ms3.baselines.bc_state.config import BcStateConfig
from robocas_ms3.baselines.bc_state.data import StateSamples, inputs
from robocas_ms3.baselines.bc_state.model import BcStateModel
from robocas_ms3.baselines.chunks.policy import ChunkPolicy
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.evaluation.policy import Observations, PolicySpec


class BcState:
    """See `Baseline`."""

    name, version = "bc-state", 1
    about = "privileged state of the simulator; chunks of poses by residual layers"
    Config = BcStateConfig

    def data(self, config: BcStateConfig, folder: Path, split: Split, on_read: OnRead) -> StateSamples:
        """Read the samples of a ``trajectory.h5``."""
        return StateSamples(config, folder, split, on_read)

    def model(self, config: BcStateConfig, facts: dict[str, Any]) -> BcStateModel:
        """Build the network."""
        return BcStateModel(config, facts)

    def policy(self, config: BcStateConfig, facts: dict[str, Any], model: BcStateModel) -> ChunkPolicy:
        """Return the policy."""
        device, size = next(model.parameters()).device, len(facts["inputs"]["mean"])

        def predict(seen: Observations, row: int) -> NDArray[np.floating]:
            assert seen.state is not None
            one = slice(row, row + 1)
            told = inputs(seen.state[one], from_wxyz(seen.tcp_in_base[one]), seen.gripper_width.reshape(-1)[one])
            if told.shape[1] != size:
                what, fix = "the policy was trained in other scenes", "Evaluate it in the task and scenes of its data."
                raise EvaluationError(what, where="bc-state", expected=f"{size} numbers", found=told.shape[1], fix=fix)
            with torch.inference_mode():
                return model.act(torch.from_numpy(told).to(device))[0].cpu().numpy()

        spec = PolicySpec("robocas", reference="tcp", rate_hz=facts["rate_hz"], state=True, language="none")
        return ChunkPolicy(spec, predict, min(config.play, config.chunk), config.fade, {})


BASELINE = BcState()
