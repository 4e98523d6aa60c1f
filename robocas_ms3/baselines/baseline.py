"""What a baseline is made of, and the settings that baselines share."""

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
"""Called with the number of episodes read, and of all."""
Fraction = Annotated[float, Field(ge=0, lt=1)]


@dataclass
class Progress:
    """Functions that a training reports to.

    Attributes:
        note: called with a line of text.
        read: called with the number of episodes read, and of all.
        step: called with the number of steps done, and of all.
    """

    note: Callable[[str], None] = lambda text: None
    read: OnRead = lambda done, total: None
    step: Callable[[int, int], None] = lambda done, total: None


def empty_split_error(path: Path, split: Split) -> EmptySplitError:
    """Return the error of a split without episodes."""
    fix = "Add episodes: a tenth of them validates."
    return EmptySplitError("this split holds no episodes", where=path, expected=f"some in {split}", fix=fix)


class TrainSettings(StrictModel):
    """Settings of supervised training.

    Attributes:
        steps: of the optimiser.
        batch_size: samples per step, of all processes together.
        learning_rate: of AdamW, after the warm-up.
        min_learning_rate: at the end of the schedule.
        weight_decay: of AdamW, on matrices and kernels; not on biases and norms.
        betas: of AdamW.
        warmup_steps: over which the learning rate rises from 0.
        schedule: ``cosine`` falls once over all steps, ``restarts`` repeatedly, ``constant`` does not.
        restart_epochs, restart_factor: first period of ``restarts`` in epochs, and the growth of each next one.
        clip_norm: largest norm of the gradient; 0: no clipping.
        ema: decay of the exponential moving average of the weights, with which policies act; 0: no average.
        seed: of all random numbers.
        precision: of the forward pass. auto: bf16 on processors and GPUs that multiply it fast, else fp32.
        workers: processes that read samples; 0: none besides this one.
        log_every, validate_every, save_every: steps between lines of the log, validations and checkpoints.
        validation_samples: most samples of the validation split, the same ones each time.
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
    """Base of the configuration of a baseline that learns from demonstrations."""

    train: TrainSettings = TrainSettings()


class Samples(Protocol):
    """Training samples, as a map-style dataset that returns whole batches.

    Attributes:
        facts: JSON values that the network and the policy need: normalisation, rate, cameras.
        episodes: number of episodes.
    """

    facts: dict[str, Any]
    episodes: int

    def __len__(self) -> int: ...

    def __getitems__(self, indices: list[int]) -> Batch: ...


@dataclass(frozen=True)
class Baseline:
    """A baseline. It learns from demonstrations (``data``), or in simulation (``environments`` and ``train``).

    Of demonstrations, the network's ``forward(batch)`` returns metrics by name: means over the batch (), ``loss`` among
    them. A metric of only some samples is a sum and the number of these samples (2,).

    Attributes:
        name: on the command line.
        version: of weights and inputs; runs of other versions can be neither continued nor used.
        Config: model of its configuration; its ``train`` has at least ``batch_size``, ``seed`` and ``precision``.
        model: makes the network of a configuration and the facts of its data.
        policy: makes the policy that acts with a configuration, facts and a trained network.
        data: reads the samples of a configuration, a dataset's path and a split, and reports its progress. Raises
            DatasetError if the dataset lacks what the baseline needs, EmptySplitError if the split has no episodes.
        environments: makes the environments of a configuration on ``cpu`` or ``cuda``: `Samples` without batches, with
            ``name`` and ``hash`` of their scenes for the record of the run, and ``close()``.
        train: trains into a `RunFolder` the network of a configuration in these environments; see `train_ppo`.
    """

    name: str
    version: int
    Config: type[StrictModel]
    model: Callable[[Any, dict[str, Any]], torch.nn.Module]
    policy: Callable[[Any, dict[str, Any], Any], Policy]
    data: Callable[[Any, Path, Split, OnRead], Samples] | None = None
    environments: Callable[[Any, str], Any] | None = None
    train: Callable[[Any, Any, Any, Any], None] | None = None
