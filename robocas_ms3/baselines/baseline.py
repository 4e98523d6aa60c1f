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
class ProgressCallbacks:
    """Callbacks of `train_run` that report its progress; by default they do nothing.

    Attributes:
        message: called with a line of text.
        on_read: called with the number of episodes read so far, and the number of all episodes.
        on_step: called with the number of training steps done so far, and the number of all steps.
    """

    message: Callable[[str], None] = lambda text: None
    on_read: OnRead = lambda done, total: None
    on_step: Callable[[int, int], None] = lambda done, total: None


def make_empty_split_error(path: Path, split: Split) -> EmptySplitError:
    """Make the error for a dataset whose split ``train`` or ``val`` has no episodes."""
    fix = "Record more episodes: 10 % of the seeds are the validation split."
    return EmptySplitError(
        "empty split of the dataset", where=path, expected=f"episodes in {split}", found="none", fix=fix
    )


class TrainSettings(StrictModel):
    """Settings of supervised training.

    Attributes:
        steps: number of optimiser steps.
        batch_size: samples per step, summed over all processes.
        learning_rate: learning rate of AdamW after the warm-up.
        min_learning_rate: learning rate at the end of the schedule, or of each period of ``restarts``.
        weight_decay: weight decay of AdamW for matrices and kernels. Biases and norms have no weight decay.
        betas: betas of AdamW.
        warmup_steps: number of first steps, in which the learning rate rises linearly from 0.
        schedule: ``cosine``: the learning rate decays once, over all steps. ``restarts``: it decays in each of several
            periods. ``constant``: it does not decay.
        restart_epochs: length of the first period of ``restarts`` in epochs.
        restart_factor: factor between the lengths of consecutive periods of ``restarts``.
        clip_norm: largest norm of the gradient; 0: no clipping.
        ema: decay per step of the exponential moving average of the weights. The policy has the averaged weights; 0:
            the policy has the last weights.
        seed: random seed.
        precision: precision of the forward pass. ``auto``: bf16 if the device has bf16 hardware, otherwise fp32.
        weights_precision: precision of the weights file. ``fp16``: half the size. The network still computes in fp32.
        workers: number of processes that read samples; 0: the training process reads them.
        log_every, validate_every, save_every: steps between lines of the log, between validations, and between
            checkpoints.
        validation_samples: maximum number of validation samples; each validation uses the same samples.
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
    weights_precision: Literal["fp32", "fp16"] = "fp32"
    workers: int = Field(default=0, ge=0, le=1024)
    log_every: int = Field(default=50, ge=1)
    validate_every: int = Field(default=1000, ge=1)
    save_every: int = Field(default=500, ge=1)
    validation_samples: int = Field(default=2048, ge=1, le=10**9)


class BaselineConfig(StrictModel):
    """Base class of the configuration of a baseline that learns from demonstrations."""

    train: TrainSettings = TrainSettings()


class Samples(Protocol):
    """Training samples of a baseline: a map-style PyTorch dataset whose ``__getitems__`` returns a batch.

    Attributes:
        facts: values of the data that network and policy need, such as normalisation, rate and image sizes; JSON types.
        episodes: number of episodes.
        scenes: optional `TrainingScenes`: an evaluation in other scenes gives a warning.
    """

    facts: dict[str, Any]
    episodes: int

    def __len__(self) -> int: ...

    def __getitems__(self, indices: list[int]) -> Batch: ...


@dataclass(frozen=True)
class Baseline:
    """Baseline: network, policy and training data.

    A baseline learns from demonstrations (``data``) or in simulation (``environments``).

    For demonstrations, ``forward(batch)`` of the network returns metrics by name, one of them ``loss``. A metric is the
    mean over the batch, shape (). If only some samples of the batch have the metric, it is the sum over these samples
    and their number, shape (2,).

    Attributes:
        name: name on the command line.
        version: version of weights and inputs. A run of another version can be neither continued nor evaluated.
        Config: class of the configuration; its ``train`` has at least ``batch_size``, ``seed`` and ``precision``.
        model: function (config, facts) that makes the network.
        policy: function (config, facts, network) that makes the policy of a trained network.
        data: function (config, path, split, on_read) that reads the training samples of a split of a dataset. Raises
            DatasetError if the dataset does not suit, and EmptySplitError if the split has no episodes.
        environments: function (config, ``cpu`` or ``cuda``) that makes the training environments: an object with the
            attributes of `Samples`, ``name`` and ``hash`` of the scenes, and ``close()``.
        train: function (run folder, network, config, environments) that trains the network, see `train_ppo`.
    """

    name: str
    version: int
    Config: type[StrictModel]
    model: Callable[[Any, dict[str, Any]], torch.nn.Module]
    policy: Callable[[Any, dict[str, Any], Any], Policy]
    data: Callable[[Any, Path, Split, OnRead], Samples] | None = None
    environments: Callable[[Any, str], Any] | None = None
    train: Callable[[Any, Any, Any, Any], None] | None = None
