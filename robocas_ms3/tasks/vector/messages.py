"""What worker processes and their starter say to each other: orders, commands, and rows of infos. All of it pickles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.tasks.vector.block import Field


@dataclass(frozen=True)
class Order:
    """What a worker is to make.

    Attributes:
        env_id: gymnasium's.
        module: where that environment is registered.
        envs: numbers of the worker's environments.
        kwargs: for ``gym.make``.
        wrappers: put around each environment, the first one first.
    """

    env_id: str
    module: str
    envs: range
    kwargs: dict[str, Any]
    wrappers: Sequence[Callable[[gym.Env], gym.Env]]


@dataclass(frozen=True)
class EnvDescription:
    """What environments that a worker has made look like, one as the other.

    Attributes:
        observation_space: of one environment.
        action_space: of one environment.
        fields: what the environments share with their starter.
        render_mode: theirs.
        metadata: theirs.
    """

    observation_space: gym.Space
    action_space: gym.Space
    fields: tuple[Field, ...]
    render_mode: str | None
    metadata: dict[str, Any]


@dataclass(frozen=True)
class Share:
    """A command, the first: share memory.

    Attributes:
        fields: what lies there.
        num_envs: how many environments there are in all processes.
    """

    fields: tuple[Field, ...]
    num_envs: int


@dataclass(frozen=True)
class Reset:
    """A command: reset some environments.

    Attributes:
        seeds: of each env to be reset its seed or None, and whether another may take its place if it has no layout.
        options: for each of them.
    """

    seeds: dict[int, tuple[int | None, bool]]
    options: dict[str, Any]


@dataclass(frozen=True)
class Call:
    """A command: call a method of every environment, or read an attribute."""

    name: str
    args: tuple
    kwargs: dict[str, Any]


@dataclass(frozen=True)
class Row:
    """A tensor (1, ...) of an info as it is sent: as an array, which takes a thirtieth of a tensor's time to pickle.

    Attributes:
        array: (1, ...).
    """

    array: NDArray[Any]

    @staticmethod
    def of(leaf: Any) -> Any:
        """The row, or what is none as it is."""
        if not isinstance(leaf, torch.Tensor) or leaf.shape[:1] != (1,) or leaf.dtype == torch.bfloat16:
            return leaf  # NumPy knows no bfloat16
        return Row(leaf.detach().cpu().numpy())

    @staticmethod
    def join(said: list[Any]) -> Any:
        """One tensor (N, ...) of the rows of all envs; where some have none, or of another shape, a list."""
        rows = [leaf.array for leaf in said if isinstance(leaf, Row)]
        if len(rows) == len(said) and len({row.shape for row in rows}) == 1:
            return torch.from_numpy(np.concatenate(rows))
        return [torch.from_numpy(leaf.array) if isinstance(leaf, Row) else leaf for leaf in said]
