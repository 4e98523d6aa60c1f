"""Checkpoints and weights of a training run as safetensors files, which need no pickle.

A checkpoint has the tensors of several state dicts: network, optimiser, random states and others. The name of a tensor
is ``STATE_DICT.NAME``. A weights file has only the tensors of the policy, without this prefix.
"""

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
    """Content of a checkpoint or of a weights file.

    Attributes:
        path: path of the file.
        step: training step at which the file was written.
        tensors: all tensors of the file, by name.
    """

    path: Path
    step: int
    tensors: dict[str, torch.Tensor]

    def state_dict(self, name: str) -> dict[str, torch.Tensor]:
        """Return the state dict with a name, such as ``optimizer``; see `join_state_dicts`."""
        prefix = f"{name}."
        return {key.removeprefix(prefix): value for key, value in self.tensors.items() if key.startswith(prefix)}

    def load_model(self, model: torch.nn.Module, name: str = "") -> None:
        """Load the state dict ``name`` into a network; empty: all tensors of a weights file.

        Raises:
            TrainingError: names or shapes differ from those of the network.
        """
        own, tensors = model.state_dict(), self.state_dict(name) if name else self.tensors
        missing, more = own.keys() - tensors.keys(), tensors.keys() - own.keys()
        shapes = [name for name in own if name in tensors and own[name].shape != tensors[name].shape]
        for key in (sorted(missing) or sorted(more) or sorted(shapes))[:1]:
            raise TrainingError(
                "the weights do not fit the network",
                where=f"{self.path}, {key}",
                expected=f"shape {list(own[key].shape)}" if key in own else "no such tensor",
                found=f"shape {list(tensors[key].shape)}" if key in tensors else "no such tensor",
                fix="Omit options that change the size of the network.",
            )
        model.load_state_dict(dict(tensors))

    def load_optimizer(self, optimizer: torch.optim.Optimizer) -> None:
        """Load the state dict ``optimizer``, made by `flatten_optimizer_state`, into an optimiser."""
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, tensor in self.state_dict("optimizer").items():
            number, _, key = name.partition(".")
            state.setdefault(int(number), {})[key] = tensor
        optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def flatten_optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """Return the state of an optimiser as tensors, by ``PARAMETER_INDEX.NAME``."""
    state: dict[int, dict[str, Any]] = optimizer.state_dict()["state"]
    return {
        f"{number}.{name}": torch.as_tensor(value) for number, values in state.items() for name, value in values.items()
    }


def join_state_dicts(**state_dicts: Tensors) -> dict[str, torch.Tensor]:
    """Return the tensors of several state dicts in one dict, by ``STATE_DICT.NAME``."""
    return {f"{prefix}.{name}": tensor for prefix, tensors in state_dicts.items() for name, tensor in tensors.items()}


def save_tensors(path: Path, tensors: Tensors, metadata: Mapping[str, str], step: int) -> None:
    """Write tensors, metadata and training step to a file, atomically."""
    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    content = _sort_header(to_bytes(copies, {**metadata, "step": str(step)}))
    with atomic_file(path, sync=True) as tmp:
        tmp.write_bytes(content)  # save_file makes files that only the owner can read


def _sort_header(content: bytes) -> bytes:
    """Sort the keys in the header of a safetensors file, so that equal tensors give equal bytes."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # aligns the tensors
    return len(header).to_bytes(8, "little") + header + content[end:]


def load_checkpoint(path: Path, expected: Mapping[str, str]) -> Checkpoint:
    """Read a checkpoint or a weights file.

    Raises:
        TrainingError: the file is missing or damaged, or its metadata differs from the ``expected`` values.
    """
    if not path.is_file():
        fix = "Continue the run: call `robocas train` with the same --out."
        raise TrainingError("missing file of the training run", where=path, fix=fix)
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            for key, value in expected.items():
                if metadata.get(key) != value:
                    found = metadata.get(key, "none")[:80]
                    fix = "Restore the files of the run, or train again."
                    raise TrainingError(
                        f"the file belongs to another {key}", where=path, expected=value, found=found, fix=fix
                    )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (no mapping)
    except (SafetensorError, OSError) as error:
        is_weights = path.name == WEIGHTS
        fix = (
            "Continue the run: `robocas train` writes the file again."
            if is_weights
            else "Start the run again: `robocas train` with --overwrite."
        )
        raise TrainingError("unreadable file", where=path, found=error, fix=fix) from error
    step = metadata.get("step", "")
    if not re.fullmatch(r"[0-9]{1,12}", step):
        fix = "Start the run again: `robocas train` with --overwrite."
        found = repr(step[:40])
        raise TrainingError(
            "invalid training step in the metadata", where=path, expected="an integer", found=found, fix=fix
        )
    return Checkpoint(path, int(step), tensors)
