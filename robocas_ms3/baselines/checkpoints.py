"""Checkpoints as one safetensors file: weights, their average, the optimiser, random states. Nothing is unpickled."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes

from robocas_ms3.errors import TrainingError
from robocas_ms3.files import replacing

_HINT = "It is damaged, or of another program: train anew with --overwrite."


def save(path: Path, tensors: Mapping[str, torch.Tensor], about: Mapping[str, str]) -> None:
    """Write tensors and texts about them; a file that was there stays whole until the new one is."""
    held = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with replacing(path, sync=True) as tmp:
        tmp.write_bytes(to_bytes(held, dict(about)))  # safetensors' own file nobody else could read


def load(path: Path, expected: Mapping[str, str]) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Read tensors, and the texts about them.

    Args:
        path: of the file.
        expected: what some of these texts have to be.

    Raises:
        TrainingError: there is no such file, it is damaged, or of something else.
    """
    if not path.is_file():
        raise TrainingError("no such file", where=path, fix="The training ended before it wrote one: --resume goes on.")
    try:
        with safe_open(path, "pt") as file:
            about = file.metadata() or {}
            for key, value in expected.items():
                if about.get(key) != value:
                    found = about.get(key, "nothing of the kind")
                    raise TrainingError(f"of another {key.replace('_', ' ')}", where=path, expected=value, found=found)
            return {name: file.get_tensor(name) for name in file.keys()}, about  # noqa: SIM118  (no mapping)
    except (SafetensorError, OSError) as error:
        raise TrainingError("can't be read", where=path, found=error, fix=_HINT) from error


def put_in(model: torch.nn.Module, tensors: Mapping[str, torch.Tensor], where: object) -> None:
    """Give a model its weights.

    Raises:
        TrainingError: they are not this model's.
    """
    own = model.state_dict()
    missing, more = own.keys() - tensors.keys(), tensors.keys() - own.keys()
    shapes = [name for name in own if name in tensors and own[name].shape != tensors[name].shape]
    for what, names in (("lacks", missing), ("has besides", more), ("has in another shape", shapes)):
        if names:
            raise TrainingError("not the weights of this model", where=where, found=f"{what} {sorted(names)[0]}")
    model.load_state_dict(dict(tensors))


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """The state of an optimiser by name: ``number of the parameter.name``."""
    state: dict[int, dict[str, Any]] = optimizer.state_dict()["state"]
    return {f"{number}.{name}": torch.as_tensor(value) for number, of in state.items() for name, value in of.items()}


def put_in_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor]) -> None:
    """Give an optimiser its state back."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        number, _, key = name.partition(".")
        state.setdefault(int(number), {})[key] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Those whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
