"""RoboCAS datasets: one declared schema, the converter, the validator, videos, statistics, a torch dataset."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robocas_ms3.datasets.training.options import SampleOptions
    from robocas_ms3.datasets.training.torch_dataset import RoboCASDataset

__all__ = ["RoboCASDataset", "SampleOptions"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from robocas_ms3.datasets.training import torch_dataset

        return getattr(torch_dataset, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
