"""Checkpoints: weights, optimiser and random states in safetensors files, without pickle."""

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

from robocas_ms3.baselines.training.record import WEIGHTS
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.files import atomic_file

Tensors = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Checkpoint:
    """Tensors of a checkpoint or weights file.

    Attributes:
        path: path of the file.
        step: training step at which it was written.
        tensors: tensors by name.
    """

    path: Path
    step: int
    tensors: dict[str, torch.Tensor]

    def part(self, name: str) -> dict[str, torch.Tensor]:
        """Return the tensors of a part by name, see `join_parts`."""
        prefix = f"{name}."
        return {key.removeprefix(prefix): value for key, value in self.tensors.items() if key.startswith(prefix)}

    def load_model(self, model: torch.nn.Module, part: str = "") -> None:
        """Load a part, or all tensors, into a model; raise TrainingError if names or shapes differ."""
        own, tensors = model.state_dict(), self.part(part) if part else self.tensors
        missing, more = own.keys() - tensors.keys(), tensors.keys() - own.keys()
        shapes = [name for name in own if name in tensors and own[name].shape != tensors[name].shape]
        for name in (sorted(missing) or sorted(more) or sorted(shapes))[:1]:
            raise TrainingError(
                "the weights do not fit the model",
                where=f"{self.path}, {name}",
                expected=list(own[name].shape) if name in own else "none",
                found=list(tensors[name].shape) if name in tensors else "none",
                fix="Omit options that change sizes: weights fit the configuration that they were trained with.",
            )
        model.load_state_dict(dict(tensors))

    def load_optimizer(self, optimizer: torch.optim.Optimizer) -> None:
        """Load the part ``optimizer``, see `optimizer_tensors`."""
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, tensor in self.part("optimizer").items():
            number, _, key = name.partition(".")
            state.setdefault(int(number), {})[key] = tensor
        optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """Return the state of an optimiser by ``PARAMETER_INDEX.NAME``."""
    state: dict[int, dict[str, Any]] = optimizer.state_dict()["state"]
    return {f"{number}.{name}": torch.as_tensor(value) for number, of in state.items() for name, value in of.items()}


def join_parts(**parts: Tensors) -> dict[str, torch.Tensor]:
    """Return the tensors of all parts by ``PART.NAME``."""
    return {f"{part}.{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()}


def save(path: Path, tensors: Tensors, metadata: Mapping[str, str], step: int) -> None:
    """Write a file of tensors atomically."""
    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    content = _sort_header(to_bytes(copies, {**metadata, "step": str(step)}))
    with atomic_file(path, sync=True) as tmp:
        tmp.write_bytes(content)  # save_file makes files that only the owner can read


def _sort_header(content: bytes) -> bytes:
    """Sort the header keys; safetensors writes metadata in random order, and results record the hash."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # aligns the tensors
    return len(header).to_bytes(8, "little") + header + content[end:]


def load(path: Path, expected: Mapping[str, str]) -> Checkpoint:
    """Read a file of tensors; raise TrainingError if it is damaged or its metadata is not as expected."""
    if not path.is_file():
        fix = "Continue the run: call `robocas train` with the same --out."
        raise TrainingError("no such file", where=path, fix=fix)
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            for key, value in expected.items():
                if metadata.get(key) != value:
                    found = metadata.get(key, "none")[:80]
                    raise TrainingError(f"wrong {key.replace('_', ' ')}", where=path, expected=value, found=found)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (no mapping)
    except (SafetensorError, OSError) as error:
        is_weights = path.name == WEIGHTS
        fix = (
            "Continue the run: `robocas train` writes the file again."
            if is_weights
            else "Start again with --overwrite."
        )
        raise TrainingError("unreadable file", where=path, found=error, fix=fix) from error
    step = metadata.get("step", "")
    if not re.fullmatch(r"[0-9]{1,12}", step):
        raise TrainingError("invalid step in the metadata", where=path, expected="an integer", found=repr(step[:40]))
    return Checkpoint(path, int(step), tensors)
