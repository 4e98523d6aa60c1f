"""Policy of a training run: ``robocas eval pick --policy RUN``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from robocas_ms3.baselines.registry import find_baseline
from robocas_ms3.baselines.training.record import BUNDLED, RUN, WEIGHTS, hash_weights, read_run
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import format_error
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, Policy, PolicySpec
from robocas_ms3.scenes.config import TaskConfig


def shipped_small() -> RunPolicy:
    """Make the policy ``small`` from the bundled weights, which are for pick; see docs/baselines.md."""
    return RunPolicy(BUNDLED / "small")


class RunPolicy:
    """Policy of a training run.

    Args:
        folder: folder of the run.
        device: ``auto`` (a GPU if there is one), ``cpu`` or ``cuda``.

    Raises:
        TrainingError: there is no run, its files are damaged, or it is a run of another version of the baseline.
    """

    def __init__(self, folder: Path, device: str = "auto") -> None:
        record = read_run(folder)
        baseline = find_baseline(record.baseline, where=folder / RUN)
        import torch

        from robocas_ms3.baselines.training import checkpoints

        if record.version != baseline.version:
            raise TrainingError(
                f"run of another version of {record.baseline}",
                where=folder,
                expected=baseline.version,
                found=record.version,
                fix="Train again, or install the release that trained it (run.json, versions).",
            )
        config = parse(baseline.Config, record.config, TrainingError, where=folder / RUN)
        weights = checkpoints.load(folder / WEIGHTS, record.metadata)
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        with _damaged_facts(folder / RUN):
            model = baseline.model(config, record.facts)
        weights.load_model(model)
        model = model.to(device).eval()
        with _damaged_facts(folder / RUN):
            self._policy: Policy = baseline.policy(config, record.facts, model)
        self._name, self._scenes, self._has_warned = f"policy {folder.name}", record.data.scenes, False
        self._description = {
            "baseline": record.baseline,
            "version": record.version,
            "steps": weights.step,
            "data": record.data.model_dump(exclude={"scenes"}),
            "trained_in": record.data.scenes.summary(),
            "config": record.config,
            "init_from": record.init_from,
            "trained_with": record.versions,
            "weights": hash_weights(folder),
        }

    @property
    def spec(self) -> PolicySpec:
        return self._policy.spec

    def describe(self) -> dict[str, Any]:
        return {**self._description, **getattr(self._policy, "describe", dict)()}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        self._policy.reset(episodes)

    def protocol_warnings(self, configs: dict[str, TaskConfig]) -> list[str]:
        """Return a warning about tasks, scenes, objects and cameras that the training data lacks.

        Each policy object warns once.
        """
        differences = [] if self._has_warned else self._scenes.differences(configs, self.spec.cameras)
        if not differences:
            return []
        self._has_warned = True
        what = f"{self._name} was not trained for {', '.join(configs)}: expect a low success rate"
        return [f"{what}. Not in the training data: {'; '.join(differences)}. Trained for: {self._scenes.summary()}."]

    def act(self, observations: Observations) -> Any:
        """Return actions (E, A), or chunks (E, H, A)."""
        return self._policy.act(observations)


@contextmanager
def _damaged_facts(path: Path) -> Iterator[None]:
    """Convert errors of building a network from damaged facts to a TrainingError with their file."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        found = format_error(error, 200)
        what = "config and facts do not make a network"
        raise TrainingError(what, where=path, found=found) from error
