"""A run's folder as a policy: ``robocas eval pick --policy RUN``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robocas_ms3.baselines.runs import RUN, SHIPPED, WEIGHTS, RunRecord, hash_of_weights, read_run
from robocas_ms3.baselines.table import find_baseline
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict import parse
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, Policy, PolicySpec


def shipped_small() -> RunPolicy:
    """The policy ``small``: trained on pick, see docs/baselines.md."""
    return RunPolicy(SHIPPED / "small")


class RunPolicy:
    """What a run has learned.

    Args:
        folder: of the run.
        device: ``auto`` (a GPU if there is one), ``cpu`` or ``cuda``.

    Raises:
        TrainingError: it is no run, has no weights yet, or is of another version.
    """

    def __init__(self, folder: Path, device: str = "auto") -> None:
        record = read_run(folder)
        baseline = find_baseline(record.baseline, where=folder / RUN)
        import torch

        from robocas_ms3.baselines import checkpoints

        if record.version != baseline.version:
            raise TrainingError(
                f"a run of another version of {record.baseline}",
                where=folder,
                expected=baseline.version,
                found=record.version,
                fix="Train anew, or use the release that it was trained with.",
            )
        config = parse(baseline.Config, record.config, TrainingError, where=folder / RUN)
        chosen = device if device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
        expected = {"baseline": record.baseline, "version": str(record.version), "dataset": record.data.hash}
        tensors, about = checkpoints.load(folder / WEIGHTS, expected)
        with checkpoints.facts_of(folder / RUN):
            model = baseline.model(config, record.facts)
        checkpoints.put_in(model, tensors, folder / WEIGHTS)
        model = model.to(chosen).eval()
        with checkpoints.facts_of(folder / RUN):
            self._policy: Policy = baseline.policy(config, record.facts, model)
        step = checkpoints.step_of(about, folder / WEIGHTS)
        self._about = {**_about(record, step), "weights": hash_of_weights(folder)}

    @property
    def spec(self) -> PolicySpec:
        """What it declares of itself."""
        return self._policy.spec

    def describe(self) -> dict[str, Any]:
        """What a result says of it: what was trained, on what, how long."""
        more = getattr(self._policy, "describe", dict)
        return {**self._about, **more()}

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Begin episodes."""
        self._policy.reset(starts)

    def act(self, observations: Observations) -> Any:
        """Actions, or chunks of them."""
        return self._policy.act(observations)


def _about(record: RunRecord, step: int) -> dict[str, Any]:
    return {
        "baseline": record.baseline,
        "version": record.version,
        "steps": step,
        "data": record.data.model_dump(),
        "config": record.config,
        "start": record.start,
        "trained_with": record.versions,
    }
