"""Training samples of `rt1`: a history of images, and the action of each step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from robocas_ms3.baselines.baseline import Batch, OnRead, Split
from robocas_ms3.baselines.dataset_checks import check_dataset, open_image_dataset
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.training.scenes import read_training_scenes
from robocas_ms3.datasets.actions import ActionScale
from robocas_ms3.datasets.training.options import SampleOptions
from robocas_ms3.datasets.training.torch_dataset import RoboCASDataset, read_sample_arrays


class RT1Samples:
    """Training samples of `rt1` from one split of a dataset.

    A batch of B samples with F frames and C cameras has

    =============  ====================  ===========================================================================
    ``rgb``        (B, F, C, 3, h, w)    uint8, scaled to ``image_size``; before an episode its first image is repeated
    ``language``   (B, 384)              float32 embeddings of the instructions
    ``action``     (B, F, 7)             float32, m and rad in the TCP frame, gripper command (1 = open)
    ``mask``       (B, F)                bool, False before the start of the episode
    ``terminate``  (B, F)                bool, True for the last ``terminate_steps`` actions of an episode
    =============  ====================  ===========================================================================

    An episode of T steps has T - 1 actions. The last action has index T - 2 and leads to step T - 1.
    """

    def __init__(self, config: RT1Config, folder: Path, split: Split, on_read: OnRead) -> None:
        source = open_image_dataset(folder)
        check_dataset(source, split, config.cameras, config.rate_hz, language=True)
        self._data = RoboCASDataset(
            folder,
            SampleOptions(
                split=split,
                observation_horizon=config.frames,
                cameras=config.cameras,
                size=config.image_size,
                embedding=True,
            ),
        )
        self._lengths, self._terminate = source.lengths, config.terminate_steps
        self.episodes, self.scenes = len(self._data.episodes), read_training_scenes(source, self._data.episodes)
        scale = ActionScale.from_action_space(source.action_space(), folder)
        for done, number in enumerate(self._data.episodes, start=1):  # finds damaged episodes before the training
            read_sample_arrays(source, number, self._data.options)
            on_read(done, self.episodes)
        first = source.episode(self._data.episodes[0])
        self.facts: dict[str, Any] = {
            "rate_hz": self._data.rate_hz,
            "cameras": {name: list(first.rgb(name, 0).shape[1::-1]) for name in config.cameras},  # as stored
            "action_low": scale.low.tolist(),
            "action_high": scale.high.tolist(),
        }

    def __len__(self) -> int:
        return len(self._data)

    def __getitems__(self, indices: list[int]) -> Batch:
        samples = [self._data[index] for index in indices]
        steps = torch.tensor([sample["step"] for sample in samples])[:, None]
        last = torch.tensor([self._lengths[sample["episode"]] - 2 for sample in samples])[:, None]
        mask = torch.stack([sample["action_mask"] for sample in samples])
        at = steps + torch.arange(1 - mask.shape[1], 1)
        return {
            "rgb": torch.stack([sample["rgb"] for sample in samples]),
            "language": torch.stack([sample["language_embedding"] for sample in samples]),
            "action": torch.stack([sample["action"] for sample in samples]),
            "mask": mask,
            "terminate": mask & (at > last - self._terminate),
        }
