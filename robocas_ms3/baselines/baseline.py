"""What a baseline is to the trainer and to the evaluation, and what all of them are trained with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from pydantic import Field

from robocas_ms3.evaluation.policy import Policy
from robocas_ms3.strict import StrictModel

Precision = Literal["auto", "fp32", "bf16"]
Split = Literal["train", "val"]
Batch = dict[str, torch.Tensor]
OnRead = Callable[[int, int], None]


class TrainSettings(StrictModel):
    """How a baseline is trained.

    Attributes:
        steps: of the optimiser.
        batch_size: samples a step, of all processes together.
        learning_rate: AdamW's, after the warm-up.
        min_learning_rate: what the schedule falls to.
        weight_decay: AdamW's, on matrices and kernels; not on biases and norms.
        warmup_steps: in which the learning rate rises from 0.
        schedule: ``cosine`` falls once over all steps, ``restarts`` again and again, ``constant`` does not.
        restart_epochs, restart_factor: first period of ``restarts`` in epochs, and what each is longer than the last.
        clip_norm: of the gradient; 0: it is not clipped.
        ema: decay of the average of the weights that policies act with, at its slowest; 0: the last weights.
        seed: of everything random.
        precision: of the forward pass. auto: bf16 on processors and GPUs that multiply it fast, else fp32.
        workers: processes that read samples; 0: this one.
        log_every, check_every, save_every: steps between lines of the log, validations and checkpoints.
        check_samples: of the validation split at most, the same each time.
    """

    steps: int = Field(default=20_000, ge=1)
    batch_size: int = Field(default=128, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)
    min_learning_rate: float = Field(default=0.0, ge=0)
    weight_decay: float = Field(default=1e-4, ge=0)
    warmup_steps: int = Field(default=200, ge=0)
    schedule: Literal["cosine", "constant", "restarts"] = "cosine"
    restart_epochs: float = Field(default=20, gt=0)
    restart_factor: int = Field(default=2, ge=1)
    clip_norm: float = Field(default=1.0, ge=0)
    ema: float = Field(default=0.999, ge=0, lt=1)
    seed: int = Field(default=0, ge=0)
    precision: Precision = "auto"
    workers: int = Field(default=0, ge=0)
    log_every: int = Field(default=50, ge=1)
    check_every: int = Field(default=1000, ge=1)
    save_every: int = Field(default=500, ge=1)
    check_samples: int = Field(default=2048, ge=1)


class BaselineConfig(StrictModel):
    """What a baseline's configuration has at least."""

    train: TrainSettings = TrainSettings()


class Samples(Protocol):
    """Training samples, map-style.

    Attributes:
        facts: JSON values that the model and the policy need to know of the data: normalisation, rate, cameras.
        episodes: how many episodes they are of.
    """

    facts: dict[str, Any]
    episodes: int

    def __len__(self) -> int: ...

    def __getitems__(self, indices: list[int]) -> Batch:
        """A whole batch."""
        ...


class Baseline(Protocol):
    """A kind of policy that can be trained.

    Attributes:
        name: as the command line has it.
        version: of its weights and inputs; another one can't be gone on with.
        about: a line for people.
        Config: form of its configuration.
    """

    name: str
    version: int
    about: str
    Config: type[BaselineConfig]

    def data(self, config: Any, folder: Path, split: Split, on_read: OnRead) -> Samples:
        """Samples of a dataset's split.

        Args:
            config: of the baseline.
            folder: the dataset, a file or a folder.
            split: of it.
            on_read: called with how many episodes were read, and how many will be, by what reads them now.

        Raises:
            DatasetError: it does not hold what the baseline is trained with, or the split holds no episodes.
        """
        ...

    def model(self, config: Any, facts: dict[str, Any]) -> torch.nn.Module:
        """The network; its ``forward(batch)`` gives means over the batch by name, ``loss`` among them."""
        ...

    def policy(self, config: Any, facts: dict[str, Any], model: torch.nn.Module) -> Policy:
        """What acts by a trained network."""
        ...
