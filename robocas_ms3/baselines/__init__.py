"""Baseline policies and their training.

Each baseline is a module or package. `training` has the trainer, and `chunks` has action chunks.

Public names are imported from this package at first use.
"""

from typing import TYPE_CHECKING

from robocas_ms3.core.lazy import make_lazy_exports

if TYPE_CHECKING:
    from robocas_ms3.baselines.baseline import Baseline as Baseline
    from robocas_ms3.baselines.baseline import BaselineConfig as BaselineConfig
    from robocas_ms3.baselines.baseline import ProgressCallbacks as ProgressCallbacks
    from robocas_ms3.baselines.baseline import Samples as Samples
    from robocas_ms3.baselines.baseline import TrainSettings as TrainSettings
    from robocas_ms3.baselines.policy import RunPolicy as RunPolicy
    from robocas_ms3.baselines.registry import find_baseline as find_baseline
    from robocas_ms3.baselines.training.record import RunRecord as RunRecord
    from robocas_ms3.baselines.training.record import read_run as read_run
    from robocas_ms3.baselines.training.session import RunOptions as RunOptions
    from robocas_ms3.baselines.training.session import train_run as train_run

__getattr__, __dir__, __all__ = make_lazy_exports(
    __name__,
    {
        "robocas_ms3.baselines.baseline": [
            "Baseline",
            "BaselineConfig",
            "ProgressCallbacks",
            "Samples",
            "TrainSettings",
        ],
        "robocas_ms3.baselines.policy": ["RunPolicy"],
        "robocas_ms3.baselines.registry": ["find_baseline"],
        "robocas_ms3.baselines.training.record": ["RunRecord", "read_run"],
        "robocas_ms3.baselines.training.session": ["RunOptions", "train_run"],
    },
)
