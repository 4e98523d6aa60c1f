"""EfficientNet's weights out of a file that the user has."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from robocas_ms3.core.errors import TrainingError

_PREFIX = "efficientnet."
_EXPECTED = "EfficientNet's weights by transformers' names"
_COUNTERS = "num_batches_tracked"  # only norms without a momentum look at them


def load_image_weights(nets: Iterable[nn.Module], path: Path) -> None:
    """Give networks of `image.efficientnet` the weights of a file; what it holds besides, as a classifier, is left.

    Args:
        nets: each gets them.
        path: of a safetensors file, or one of ``torch.save``.

    Raises:
        TrainingError: it can't be read, or lacks some of them in this shape.
    """
    tensors = {name.removeprefix(_PREFIX): value for name, value in _read(path).items()}
    for net in nets:
        own = net.state_dict()
        wrong = [name for name in own if _wrong(name, own[name], tensors)]
        if wrong:
            raise TrainingError(
                "not the weights of this network",
                where=path,
                expected=f"{_EXPECTED}, such as {wrong[0]} {tuple(own[wrong[0]].shape)}",
                found=f"{len(wrong)} of {len(own)} missing or of another shape",
                fix="image_width and image_depth say which EfficientNet: 1.2 and 1.4 are B3.",
            )
        net.load_state_dict({name: tensors.get(name, value) for name, value in own.items()})


def _wrong(name: str, own: torch.Tensor, tensors: Mapping[str, Any]) -> bool:
    found = tensors.get(name)
    if found is None:
        return not name.endswith(_COUNTERS)
    return not isinstance(found, torch.Tensor) or found.shape != own.shape


def _read(path: Path) -> dict[str, Any]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        if path.suffix == ".safetensors":
            found: Any = load_file(path)
        else:
            found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, SafetensorError, pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        said = str(error).partition("\n")[0]
        raise TrainingError("can't be read", where=path, expected=_EXPECTED, found=said) from error
    if not isinstance(found, dict):
        raise TrainingError("no weights", where=path, expected=_EXPECTED, found=type(found).__name__)
    return found
