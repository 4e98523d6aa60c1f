"""The folder of a training run as a policy: ``robocas eval pick --policy RUN``."""

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


def shipped_small() -> RunPolicy:
    """Return the policy ``small`` with the bundled weights, see docs/baselines.md."""
    return RunPolicy(BUNDLED / "small")


class RunPolicy:
    """The policy of a run.

    Args:
        folder: of the run.
        device: ``auto`` (a GPU if there is one), ``cpu`` or ``cuda``.
    """

    def __init__(self, folder: Path, device: str = "auto") -> None:
        record = read_run(folder)
        baseline = find_baseline(record.baseline, where=folder / RUN)
        import torch

        from robocas_ms3.baselines.training import checkpoints

        if record.version != baseline.version:
            raise TrainingError(
                f"a run of another version of {record.baseline}",
                where=folder,
                expected=baseline.version,
                found=record.version,
                fix="Train again, or use the release that it was trained with.",
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
        self._about = {
            "baseline": record.baseline,
            "version": record.version,
            "steps": weights.step,
            "data": record.data.model_dump(),
            "config": record.config,
            "start": record.start,
            "trained_with": record.versions,
            "weights": hash_weights(folder),
        }

    @property
    def spec(self) -> PolicySpec:
        return self._policy.spec

    def describe(self) -> dict[str, Any]:
        return {**self._about, **getattr(self._policy, "describe", dict)()}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        self._policy.reset(episodes)

    def act(self, observations: Observations) -> Any:
        """Return actions, or chunks of them."""
        return self._policy.act(observations)


@contextmanager
def _damaged_facts(path: Path) -> Iterator[None]:
    """Turn errors of building a network or policy from damaged facts into one that names their file."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        found = format_error(error, 200)
        what = "no network can be built from this configuration and these facts"
        raise TrainingError(what, where=path, found=found) from error
