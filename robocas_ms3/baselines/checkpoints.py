"""Checkpoints as one safetensors file: weights, their average, the optimiser, random states. Nothing is unpickled."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes

from robocas_ms3.baselines.runs import CHECKPOINT, WEIGHTS
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.files import replacing

_HINTS = {
    CHECKPOINT: "It is damaged, or of another program: train anew with --overwrite.",
    WEIGHTS: "It is damaged, or of another program: `robocas train` into this folder writes it again.",
}


def save(path: Path, tensors: Mapping[str, torch.Tensor], about: Mapping[str, str]) -> None:
    """Write tensors and texts about them; a file that was there stays whole until the new one is."""
    held = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with replacing(path, sync=True) as tmp:
        tmp.write_bytes(_in_order(to_bytes(held, dict(about))))  # safetensors' own file nobody else could read


def _in_order(made: bytes) -> bytes:
    """The same with its header's keys sorted: safetensors has texts in any order, and results are named by a hash."""
    end = 8 + int.from_bytes(made[:8], "little")
    header = json.dumps(json.loads(made[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # so that tensors are aligned
    return len(header).to_bytes(8, "little") + header + made[end:]


def save_run(
    folder: Path, checkpoint: Mapping[str, torch.Tensor], weights: Mapping[str, torch.Tensor], about: Mapping[str, str]
) -> None:
    """Write what a run acts with, then what it goes on from: where that is at the last step, so are the weights."""
    save(folder / WEIGHTS, weights, about)
    save(folder / CHECKPOINT, checkpoint, about)


def mend_weights(folder: Path, weights: Mapping[str, torch.Tensor], about: Mapping[str, str]) -> None:
    """Write what a run acts with where that is missing, damaged, or of another step than its checkpoint."""
    try:
        load(folder / WEIGHTS, about)
    except TrainingError:
        save(folder / WEIGHTS, weights, about)


def load(path: Path, expected: Mapping[str, str]) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Read tensors, and the texts about them.

    Args:
        path: of the file.
        expected: what some of these texts have to be.

    Raises:
        TrainingError: there is no such file, it is damaged, or of something else.
    """
    if not path.is_file():
        fix = "`robocas train` into this folder continues a training that ended before it wrote one."
        raise TrainingError("no such file", where=path, fix=fix)
    try:
        with safe_open(path, "pt") as file:
            about = file.metadata() or {}
            for key, value in expected.items():
                if about.get(key) != value:
                    found = about.get(key, "nothing of the kind")[:80]
                    raise TrainingError(f"of another {key.replace('_', ' ')}", where=path, expected=value, found=found)
            return {name: file.get_tensor(name) for name in file.keys()}, about  # noqa: SIM118  (no mapping)
    except (SafetensorError, OSError) as error:
        hint = _HINTS.get(path.name, _HINTS[CHECKPOINT])
        raise TrainingError("can't be read", where=path, found=error, fix=hint) from error


@contextmanager
def facts_of(path: Path) -> Iterator[None]:
    """Turn errors of building a model or policy from the facts of a run into one that names their file.

    Raises:
        TrainingError: the facts of a ``run.json`` are not those of the baseline.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        found = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise TrainingError("its configuration and facts make no model", where=path, found=found) from error


def step_of(about: Mapping[str, str], path: Path) -> int:
    """Return the step that a checkpoint was written at, by the texts in it.

    Raises:
        TrainingError: they do not say.
    """
    step = about.get("step", "")
    if not re.fullmatch(r"[0-9]{1,12}", step):
        raise TrainingError("no step of a training", where=path, expected="a whole number", found=repr(step[:40]))
    return int(step)


def put_in(model: torch.nn.Module, tensors: Mapping[str, torch.Tensor], where: object) -> None:
    """Give a model its weights.

    Raises:
        TrainingError: they are not this model's.
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
                fix="They fit the configuration that they were trained with: leave out what changes sizes.",
            )
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
