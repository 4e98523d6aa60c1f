"""Policy of a training run: ``robocas eval pick --policy RUN``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.registry import find_baseline
from robocas_ms3.baselines.training.record import BUNDLED, RUN, WEIGHTS, hash_weights, read_run
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import format_error
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, Policy, PolicySpec, find_image_requests
from robocas_ms3.scenes.config import TaskConfig


class RunPolicy:
    """Policy with the weights of a training run.

    Args:
        folder: output folder of `robocas train`.
        device: ``auto`` (a GPU if there is one), ``cpu`` or ``cuda``.

    Raises:
        TrainingError: the folder has no run, its files are damaged, or another version of the baseline wrote them.
    """

    def __init__(self, folder: Path, device: str = "auto") -> None:
        record = read_run(folder)
        baseline = find_baseline(record.baseline, where=folder / RUN)
        import torch

        from robocas_ms3.baselines.training import checkpoints
        from robocas_ms3.baselines.training.metrics import read_training_seconds

        if record.version != baseline.version:
            raise TrainingError(
                f"the run was trained with another version of {record.baseline}",
                where=folder,
                expected=f"version {baseline.version}",
                found=f"version {record.version}",
                fix="Train again, or install the release of robocas-ms3 in run.json (versions).",
            )
        config: Any = parse(baseline.Config, record.config, TrainingError, where=folder / RUN)
        weights = checkpoints.load_checkpoint(folder / WEIGHTS, record.metadata)
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        with _convert_fact_errors(folder / RUN):
            model = baseline.model(config, record.facts)
        weights.load_model(model)
        model = model.to(device).eval()
        with _convert_fact_errors(folder / RUN):
            self._policy: Policy = baseline.policy(config, record.facts, model)
        self._name, self._scenes, self._has_warned = f"policy {folder.name}", record.data.scenes, False
        steps = config.train.steps
        self._stopped = ""
        if weights.step < steps:
            again = "Continue it with the same robocas train command."
            self._stopped = f"{self._name}: training stopped at step {weights.step} of {steps}. {again}"
        self._description = {
            "baseline": record.baseline,
            "version": record.version,
            "steps": weights.step,
            "data": record.data.model_dump(exclude={"scenes"}),
            "trained_in": record.data.scenes.summarize(),
            "config": record.config,
            "init_from": record.init_from,
            "trained_with": record.versions,
            "training_seconds": read_training_seconds(folder, weights.step),
            "hardware": record.hardware or record.device,
            "parameters": sum(parameter.numel() for parameter in model.parameters()),
            "weights": hash_weights(folder),
        }

    @property
    def spec(self) -> PolicySpec:
        """Return the observations that the policy needs, its rate, and the convention of its actions."""
        return self._policy.spec

    def describe(self) -> dict[str, Any]:
        """Return the baseline, training data and cost, configuration and weights hash, for the record of a result."""
        return {**self._description, **getattr(self._policy, "describe", dict)()}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start new episodes in some of the envs."""
        self._policy.reset(episodes)

    def check_robot(self, robot: str) -> None:
        """Raise a `RobocasError` if the policy cannot control the robot with this name."""
        getattr(self._policy, "check_robot", lambda robot: None)(robot)

    def requests_images(self, envs: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (E,) bool, whether the next call of `act` needs images of each env."""
        return find_image_requests(self._policy, envs)

    def list_training_differences(self, configs: dict[str, TaskConfig]) -> dict[str, list[str]] | None:
        """Return by configuration the tasks, scene settings, objects and cameras that the training data lacks.

        None: the scenes of the training data are unknown.
        """
        scenes, cameras = self._scenes, self.spec.cameras
        if not (scenes.tasks and scenes.configs and scenes.objects):
            return None
        return {name: scenes.list_differences({name: config}, cameras) for name, config in configs.items()}

    def protocol_warnings(self, configs: dict[str, TaskConfig]) -> list[str]:
        """Warn if the training stopped early, or if its data lacks tasks, scenes, objects or cameras of configurations.

        Returns:
            At most two warnings; empty after the first call.
        """
        if self._has_warned:
            return []
        self._has_warned = True
        warnings = [self._stopped] if self._stopped else []
        cameras, scenes = self.spec.cameras, self._scenes
        new = {name: one for name, one in configs.items() if scenes.list_differences({name: one}, cameras)}
        differences = scenes.list_differences(new, cameras)
        if len(differences) == 1 and differences[0].startswith("task "):  # another task in known scenes
            trained, other = ", ".join(scenes.tasks), differences[0].removeprefix("task ")
            warnings.append(f"{self._name} was trained for {trained}, not for {other}.")
        elif differences:
            what = f"{self._name} was not trained for {', '.join(new)}: its success rate may be lower there"
            lacks = f"Not in the training data: {'; '.join(differences)}"
            warnings.append(f"{what}. {lacks}. Trained for: {scenes.summarize()}.")
        return warnings

    def act(self, observations: Observations) -> Any:
        """Return one action per env (E, A), or one chunk of H actions per env (E, H, A)."""
        return self._policy.act(observations)


@contextmanager
def _convert_fact_errors(path: Path) -> Iterator[None]:
    """Raise TrainingError in place of the errors that damaged values in ``run.json`` cause.

    path: path of ``run.json``, for the message.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        found = format_error(error, 200)
        what, fix = "cannot build the network from config and facts", "Restore the file, or train again."
        raise TrainingError(what, where=path, found=found, fix=fix) from error


def describe_bundled(name: str) -> str:
    """Return the baseline, tasks and scenes of the bundled weights with this name; empty if there are none."""
    if not (BUNDLED / name / RUN).is_file():
        return ""
    record = read_run(BUNDLED / name)
    tasks, scenes = ", ".join(record.data.scenes.tasks), ", ".join(record.data.scenes.configs)
    return f"{record.baseline}, trained for {tasks} in {scenes}"


bundled_small = partial(RunPolicy, BUNDLED / "small")
bundled_small_ms3 = partial(RunPolicy, BUNDLED / "small-ms3")
bundled_keyframe = partial(RunPolicy, BUNDLED / "keyframe")
bundled_keyframe_upstream = partial(RunPolicy, BUNDLED / "keyframe-upstream")
bundled_keyframe_upstream_eval = partial(RunPolicy, BUNDLED / "keyframe-upstream-eval")
