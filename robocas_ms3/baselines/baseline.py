"""Types of a baseline, and the settings that baselines share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import torch
from pydantic import Field

from robocas_ms3.core.errors import EmptySplitError
from robocas_ms3.core.strict_model import StrictModel
from robocas_ms3.evaluation.policy import Policy

Precision = Literal["auto", "fp32", "bf16"]
Split = Literal["train", "val"]
Batch = dict[str, torch.Tensor]
OnRead = Callable[[int, int], None]
"""Function called with the number of episodes read and their total number."""
Fraction = Annotated[float, Field(ge=0, lt=1)]


@dataclass
class Progress:
    """Functions that report the progress of a training run.

    Attributes:
        message: called with a line of text.
        on_read: called with the number of episodes read and their total number.
        on_step: called with the number of optimiser steps done and their total number.
    """

    message: Callable[[str], None] = lambda text: None
    on_read: OnRead = lambda done, total: None
    on_step: Callable[[int, int], None] = lambda done, total: None


def empty_split_error(path: Path, split: Split) -> EmptySplitError:
    """Return the error of a split without episodes."""
    fix = "Add episodes: 10 % of the seeds are the validation split."
    return EmptySplitError("empty split of the dataset", where=path, expected=f"episodes in {split}", fix=fix)


class TrainSettings(StrictModel):
    """Settings of supervised training.

    Attributes:
        steps: number of optimiser steps.
        batch_size: samples per step, summed over all processes.
        learning_rate: learning rate of AdamW after the warm-up.
        min_learning_rate: learning rate at the end of the schedule.
        weight_decay: weight decay of AdamW, for matrices and kernels; biases and norms have none.
        betas: betas of AdamW.
        warmup_steps: steps in which the learning rate rises from 0.
        schedule: ``cosine`` decays once over all steps, ``restarts`` repeatedly, ``constant`` not at all.
        restart_epochs, restart_factor: first period of ``restarts`` in epochs, and the factor of each next period.
        clip_norm: largest norm of the gradient; 0: no clipping.
        ema: decay of the exponential moving average of the weights, which the policy uses; 0: no average.
        seed: random seed.
        precision: precision of the forward pass. auto: bf16 where the device supports it in hardware, else fp32.
        workers: processes that read samples; 0: the training process reads them.
        log_every, validate_every, save_every: steps between lines of the log, validations and checkpoints.
        validation_samples: largest number of validation samples; the same samples at each validation.
    """

    steps: int = Field(default=20_000, ge=1, le=10**9)
    batch_size: int = Field(default=128, ge=1, le=10**6)
    learning_rate: float = Field(default=1e-3, gt=0)
    min_learning_rate: float = Field(default=0.0, ge=0)
    weight_decay: float = Field(default=1e-4, ge=0)
    betas: tuple[Fraction, Fraction] = (0.9, 0.95)
    warmup_steps: int = Field(default=200, ge=0)
    schedule: Literal["cosine", "constant", "restarts"] = "cosine"
    restart_epochs: float = Field(default=20, gt=0)
    restart_factor: int = Field(default=2, ge=1)
    clip_norm: float = Field(default=1.0, ge=0)
    ema: float = Field(default=0.999, ge=0, lt=1)
    seed: int = Field(default=0, ge=0)
    precision: Precision = "auto"
    workers: int = Field(default=0, ge=0, le=1024)
    log_every: int = Field(default=50, ge=1)
    validate_every: int = Field(default=1000, ge=1)
    save_every: int = Field(default=500, ge=1)
    validation_samples: int = Field(default=2048, ge=1, le=10**9)


class BaselineConfig(StrictModel):
    """Base class of the configuration of a baseline that learns from demonstrations."""

    train: TrainSettings = TrainSettings()


class Samples(Protocol):
    """Training samples: a map-style dataset that returns whole batches.

    Attributes:
        facts: JSON values that network and policy need: normalisation, rate, image sizes.
        episodes: number of episodes.
        scenes: optional `TrainingScenes`, for a warning in an evaluation with other scenes.
    """

    facts: dict[str, Any]
    episodes: int

    def __len__(self) -> int: ...

    def __getitems__(self, indices: list[int]) -> Batch: ...


@dataclass(frozen=True)
class Baseline:
    """Baseline that learns from demonstrations (``data``) or in simulation (``environments``).

    For demonstrations, the network's ``forward(batch)`` returns metrics by name, with ``loss``: means over the batch,
    shape (). A metric that only some samples have is a sum and the number of these samples, shape (2,).

    Attributes:
        name: name on the command line.
        version: version of weights and inputs; runs of other versions can be neither continued nor used.
        Config: model of the configuration; its ``train`` has at least ``batch_size``, ``seed`` and ``precision``.
        model: function that makes the network, from configuration and facts.
        policy: function that makes the policy, from configuration, facts and trained network.
        data: function that reads the samples of a dataset's split, from configuration, path, split and progress
            function. Raises DatasetError if the dataset does not suit, EmptySplitError if the split has no episodes.
        environments: function that makes the training environments, from configuration and ``cpu`` or ``cuda``:
            `Samples` without batches, with ``name`` and ``hash`` of their scenes, and ``close()``.
        train: function that trains the network in these environments and writes to a `RunFolder`; see `train_ppo`.
    """

    name: str
    version: int
    Config: type[StrictModel]
    model: Callable[[Any, dict[str, Any]], torch.nn.Module]
    policy: Callable[[Any, dict[str, Any], Any], Policy]
    data: Callable[[Any, Path, Split, OnRead], Samples] | None = None
    environments: Callable[[Any, str], Any] | None = None
    train: Callable[[Any, Any, Any, Any], None] | None = None
