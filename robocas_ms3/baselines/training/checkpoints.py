"""Tensors in safetensors files: weights, optimiser and random states. Nothing is unpickled."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes

from robocas_ms3.baselines.training.record import CHECKPOINT, WEIGHTS
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.files import replacing

_FIXES = {
    CHECKPOINT: "It is damaged, or of another program: start again with --overwrite.",
    WEIGHTS: "It is damaged, or of another program: `robocas train` into this folder writes it again.",
}


@dataclass(frozen=True)
class Checkpoint:
    """The state of a training at a step.

    Attributes:
        path: of the file.
        step: at which it was written.
        tensors: by name.
    """

    path: Path
    step: int
    tensors: dict[str, torch.Tensor]

    def part(self, prefix: str) -> dict[str, torch.Tensor]:
        """Return the tensors whose names start with a prefix, without it."""
        parts = {name: tensor for name, tensor in self.tensors.items() if name.startswith(prefix)}
        return {name.removeprefix(prefix): tensor for name, tensor in parts.items()}


def save(path: Path, tensors: Mapping[str, torch.Tensor], about: Mapping[str, str]) -> None:
    """Write tensors and metadata; an existing file stays whole until the new one is."""
    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with replacing(path, sync=True) as tmp:
        tmp.write_bytes(_sort_header(to_bytes(copies, dict(about))))  # save_file writes files that only the owner reads


def _sort_header(content: bytes) -> bytes:
    """Sort the keys of the header: safetensors writes metadata in any order, and results name weights by their hash."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # aligns the tensors
    return len(header).to_bytes(8, "little") + header + content[end:]


def load(path: Path, expected: Mapping[str, str]) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Read tensors and metadata.

    Args:
        path: of the file.
        expected: metadata that has to match.

    Raises:
        TrainingError: the file is missing or damaged, or its metadata differ.
    """
    if not path.is_file():
        fix = "`robocas train` into this folder continues a training that ended before it wrote one."
        raise TrainingError("no such file", where=path, fix=fix)
    try:
        with safe_open(path, "pt") as file:
            about = file.metadata() or {}
            for key, value in expected.items():
                if about.get(key) != value:
                    found = about.get(key, "none")[:80]
                    raise TrainingError(f"another {key.replace('_', ' ')}", where=path, expected=value, found=found)
            return {name: file.get_tensor(name) for name in file.keys()}, about  # noqa: SIM118  (no mapping)
    except (SafetensorError, OSError) as error:
        fix = _FIXES.get(path.name, _FIXES[CHECKPOINT])
        raise TrainingError("can't be read", where=path, found=error, fix=fix) from error


def load_checkpoint(path: Path, expected: Mapping[str, str]) -> Checkpoint:
    """Read the checkpoint of a run.

    Raises:
        TrainingError: see `load`.
    """
    tensors, about = load(path, expected)
    return Checkpoint(path, read_step(about, path), tensors)


def read_step(about: Mapping[str, str], path: Path) -> int:
    """Return the step in the metadata of a file.

    Raises:
        TrainingError: there is none.
    """
    step = about.get("step", "")
    if not re.fullmatch(r"[0-9]{1,12}", step):
        raise TrainingError("no step of a training", where=path, expected="a whole number", found=repr(step[:40]))
    return int(step)


def load_weights(model: torch.nn.Module, tensors: Mapping[str, torch.Tensor], where: object) -> None:
    """Load weights into a network.

    Raises:
        TrainingError: they are of another network.
    """
    own = model.state_dict()
    missing, more = own.keys() - tensors.keys(), tensors.keys() - own.keys()
    shapes = [name for name in own if name in tensors and own[name].shape != tensors[name].shape]
    for names, expected, found in ((missing, own, {}), (more, {}, tensors), (shapes, own, tensors)):
        if names:
            name = sorted(names)[0]
            raise TrainingError(
                "not the weights of this model",
                where=f"{where}, {name}",
                expected=list(expected[name].shape) if name in expected else "none",
                found=list(found[name].shape) if name in found else "none",
                fix="They fit the configuration that they were trained with: leave out options that change sizes.",
            )
    model.load_state_dict(dict(tensors))


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """Return the state of an optimiser by ``number of the parameter.name``."""
    state: dict[int, dict[str, Any]] = optimizer.state_dict()["state"]
    return {f"{number}.{name}": torch.as_tensor(value) for number, of in state.items() for name, value in of.items()}


def load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor]) -> None:
    """Load the state of `optimizer_tensors` into an optimiser."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        number, _, key = name.partition(".")
        state.setdefault(int(number), {})[key] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def with_prefix(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return tensors with a prefix before their names, see `Checkpoint.part`."""
    return {f"{prefix}{name}": tensor for name, tensor in tensors.items()}
