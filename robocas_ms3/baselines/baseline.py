"""What a baseline is to the trainer and to the evaluation, and what all of them are trained with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import torch
from pydantic import Field

from robocas_ms3.core.strict import StrictModel
from robocas_ms3.evaluation.policy import Policy

Precision = Literal["auto", "fp32", "bf16"]
Split = Literal["train", "val"]
Batch = dict[str, torch.Tensor]
OnRead = Callable[[int, int], None]
Share = Annotated[float, Field(ge=0, lt=1)]


class TrainSettings(StrictModel):
    """How a baseline is trained.

    Attributes:
        steps: of the optimiser.
        batch_size: samples a step, of all processes together.
        learning_rate: AdamW's, after the warm-up.
        min_learning_rate: what the schedule falls to.
        weight_decay: AdamW's, on matrices and kernels; not on biases and norms.
        betas: AdamW's, decay of the means of gradients and of their squares.
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

    steps: int = Field(default=20_000, ge=1, le=10**9)
    batch_size: int = Field(default=128, ge=1, le=10**6)
    learning_rate: float = Field(default=1e-3, gt=0)
    min_learning_rate: float = Field(default=0.0, ge=0)
    weight_decay: float = Field(default=1e-4, ge=0)
    betas: tuple[Share, Share] = (0.9, 0.95)
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
    check_every: int = Field(default=1000, ge=1)
    save_every: int = Field(default=500, ge=1)
    check_samples: int = Field(default=2048, ge=1, le=10**9)


class BaselineConfig(StrictModel):
    """What a baseline's configuration has at least."""

    train: TrainSettings = TrainSettings()


class TrialSettings(StrictModel):
    """How a baseline that learns by trying is trained.

    Attributes:
        steps: of all environments together; as many more as the last update has.
        batch_size: steps between updates, of all environments together.
        learning_rate: of the optimiser.
        clip_norm: of the gradient; 0: it is not clipped.
        seed: of everything random but the environments.
        precision: of the forward pass.
        save_every: steps between checkpoints.
    """

    steps: int = Field(default=100_000, ge=1, le=10**9)
    batch_size: int = Field(default=512, ge=2, le=10**6)
    learning_rate: float = Field(default=7e-4, gt=0)
    clip_norm: float = Field(default=0.5, ge=0)
    seed: int = Field(default=0, ge=0)
    precision: Literal["fp32"] = "fp32"
    save_every: int = Field(default=5000, ge=1)


class TrialConfig(StrictModel):
    """What the configuration of a baseline that learns by trying has at least."""

    train: TrialSettings = TrialSettings()


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


class Trials(Protocol):
    """What a baseline learns in that learns by trying.

    Attributes:
        name: for people.
        hash: of the scenes.
        facts: JSON values that the model and the policy need to know.
        episodes: how many different ones there are.
    """

    name: str
    hash: str
    facts: dict[str, Any]
    episodes: int

    def __len__(self) -> int:
        """Steps to be taken."""
        ...

    def close(self) -> None:
        """End what they run in."""
        ...


class Training(Protocol):
    """A run that takes the steps that are left, and keeps checkpoints, weights and metrics in its folder.

    Attributes:
        step: steps taken.
    """

    step: int

    def parameters(self) -> Iterator[torch.nn.Parameter]:
        """Of the network."""
        ...

    def train(self, on_step: Callable[[int, int], None]) -> None:
        """Take all steps that are left; what there is to call with the steps done and all steps."""
        ...


class _Kind(Protocol):
    """A kind of policy that can be trained.

    Attributes:
        name: as the command line has it.
        version: of its weights and inputs; another one can't be gone on with.
        about: a line for people.
    """

    name: str
    version: int
    about: str

    def policy(self, config: Any, facts: dict[str, Any], model: Any) -> Policy:
        """What acts by a trained network."""
        ...


class Baseline(_Kind, Protocol):
    """One that learns from data.

    Attributes:
        Config: form of its configuration.
    """

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
        """The network.

        Its ``forward(batch)`` gives metrics by name: means over the batch (), ``loss`` among them, and for what not all
        of its samples tell, a sum and how many did (2,).
        """
        ...


class TrialBaseline(_Kind, Protocol):
    """One that learns by trying, with a trainer of its own.

    Attributes:
        Config: form of its configuration.
        trials: (configuration, ``cpu`` or ``cuda``) to what it learns in.
        training: (configuration, trials, `OutputFolder`, `RunRecord`, accelerator, start=, on_note=) to a `Training`.
    """

    Config: type[TrialConfig]
    trials: Callable[..., Trials]
    training: Callable[..., Training]

    def model(self, config: Any, facts: dict[str, Any]) -> torch.nn.Module:
        """The network."""
        ...
