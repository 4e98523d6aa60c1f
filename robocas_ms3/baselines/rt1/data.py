"""Training samples of `rt1`: six frames of pictures, and the action beside each."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.bases import check_bases, check_tcp
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.datasets.actions import ActionScale
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.sources.protocol import EpisodeSource
from robocas_ms3.datasets.training.torch_dataset import RoboCASDataset
from robocas_ms3.errors import DatasetError


class RT1Samples(torch.utils.data.Dataset):
    """Samples of a dataset's split.

    A batch of B samples of F frames and C cameras holds

    =============  ====================  ===========================================================================
    ``rgb``        (B, F, C, 3, h, w)    uint8, scaled to ``config.picture``; the first one repeated before an episode
    ``language``   (B, 384)              float32 embeddings of the instructions
    ``action``     (B, F, 7)             float32, m and rad in the TCP's frame, gripper command (1 = open)
    ``mask``       (B, F)                bool, False = before the episode
    ``terminate``  (B, F)                bool, whether the action is among the last ``terminate_steps`` of its episode
    =============  ====================  ===========================================================================

    The last action is the one that leads to an episode's last step, T - 2: after it there is nothing to do.

    Args:
        config: what is looked at.
        folder: of the dataset.
        split: of it.

    Raises:
        DatasetError: it lacks embeddings or a camera, is of another rate, has no such split, is damaged, or its base
            drives.
    """

    def __init__(self, config: RT1Config, folder: Path, split: Literal["train", "val"]) -> None:
        source = open_source(folder)
        _check(source, config)
        for number in source.split(split)[:1]:
            check_tcp(source, number)
        check_bases(source, source.split(split))
        self._data = RoboCASDataset(
            folder,
            split=split,
            observation_horizon=config.frames,
            cameras=config.cameras,
            size=config.picture,
            embedding=True,
        )
        self._lengths, self._terminate = source.lengths, config.terminate_steps
        self.episodes = len(self._data.episodes)
        scale = ActionScale.of(source.action_space(), folder)
        first = source.episode(self._data.episodes[0])
        self.facts: dict[str, Any] = {
            "rate_hz": self._data.rate_hz,
            "cameras": {name: list(first.rgb(name, 0).shape[1::-1]) for name in config.cameras},
            "action_low": scale.low.tolist(),
            "action_high": scale.high.tolist(),
        }
        """Rate; width and height of the pictures as they are stored, by camera; ranges of the motion, m and rad."""

    def __len__(self) -> int:
        return len(self._data)

    def __getitems__(self, indices: list[int]) -> Batch:
        """A batch.

        Raises:
            DatasetError: a file is missing or damaged, or holds what is no number.
        """
        samples = [self._data[index] for index in indices]
        steps = torch.tensor([sample["step"] for sample in samples])[:, None]
        last = torch.tensor([self._lengths[sample["episode"]] - 2 for sample in samples])[:, None]
        mask = torch.stack([sample["action_mask"] for sample in samples])
        acted = steps + torch.arange(1 - mask.shape[1], 1)
        return {
            "rgb": torch.stack([sample["rgb"] for sample in samples]),
            "language": torch.stack([sample["language_embedding"] for sample in samples]),
            "action": torch.stack([sample["action"] for sample in samples]),
            "mask": mask,
            "terminate": mask & (acted > last - self._terminate),
        }


def _check(source: EpisodeSource, config: RT1Config) -> None:
    """See that a dataset holds what samples are made of, before anything is read.

    Raises:
        DatasetError: it does not.
    """
    missing = [name for name in config.cameras if name not in source.cameras]
    if missing:
        raise DatasetError(
            "no pictures of a camera of rt1",
            where=source.root,
            expected=", ".join(config.cameras),
            found=", ".join(source.cameras) or "none",
            fix="Convert the trajectory with these cameras, or set cameras of the configuration.",
        )
    if not source.has_embeddings:
        fix = "Convert the trajectory with embeddings; a LeRobot folder has none."
        raise DatasetError("rt1 needs embeddings of the instructions", where=source.root, found="none", fix=fix)
    if source.rate_hz != config.rate_hz:
        raise DatasetError(
            "steps at another rate than rt1 is to act at",
            where=source.root,
            expected=f"{config.rate_hz:g} Hz",
            found=f"{source.rate_hz:g} Hz",
            fix=f"Convert with --rate {config.rate_hz:g}, or set rate_hz={source.rate_hz:g}.",
        )
