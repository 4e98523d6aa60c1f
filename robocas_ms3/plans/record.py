"""Records the episode of a seed, in a process of a slot."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from robocas_ms3.demos.episode import EpisodeSettings
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.files import write_json
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import Task
from robocas_ms3.processes import use_one_torch_thread
from robocas_ms3.recordings.entries import read_json


def settings_of(plan: Plan, part: int) -> EpisodeSettings:
    """How a part's episodes are recorded."""
    one = plan.parts[part]
    assert one.config is not None  # a loaded plan names all
    rate = int(plan.rate) if plan.rate == int(plan.rate) else 5  # actions are tried as the dataset will hold them
    return EpisodeSettings(one.task, one.config, one.pack, plan.control_freq, replay_rate=rate)


class Records:
    """Records episodes; keeps the environment from one to the next of the same part."""

    def __init__(self, plan: Plan) -> None:
        use_one_torch_thread()
        self._plan = plan
        self._settings: EpisodeSettings | None = None
        self._generator: EpisodeGenerator | None = None

    def do(self, task: Task) -> dict[str, Any]:
        """Record a seed's episode, and say what came of it."""
        begun = _cpu_seconds()
        if not task.recording.is_file():  # else it was killed between this and the ledger's line
            made = task.recording.with_name(f".{task.recording.stem}.tmp.h5")
            result = self._of(task).generate(task.seed, task.folder, made.stem)
            failures = [f"{failure.stage}: {failure.reason}" for failure in result.failures]
            if not result.success:
                return {"failures": failures, "record_seconds": round(_cpu_seconds() - begun, 2)}
            _forget_clock(made, failures)
            os.replace(made.with_suffix(".json"), task.recording.with_suffix(".json"))
            os.replace(made, task.recording)
        said = read_json(task.recording)["episodes"][0]
        return {
            "success": True,
            "steps": said["elapsed_steps"],
            "failures": said["robocas"]["failed_attempts"],
            "record_seconds": round(_cpu_seconds() - begun, 2),
        }

    def _of(self, task: Task) -> EpisodeGenerator:
        settings = settings_of(self._plan, task.part)
        if self._generator is None or settings != self._settings:
            self.close()
            self._settings, self._generator = settings, EpisodeGenerator(settings)
        return self._generator

    def close(self) -> None:
        """Close the environments."""
        if self._generator is not None:
            self._generator.close()
            self._generator = None


def _forget_clock(recording: Path, failures: list[str]) -> None:
    """Leave out of a recording what a clock said, so that whoever makes it makes the same; note what failed."""
    path = recording.with_suffix(".json")
    content = read_json(recording)
    for episode in content["episodes"]:
        episode["robocas"].pop("seconds", None)
        episode["robocas"]["failed_attempts"] = failures
    write_json(path, content)


def _cpu_seconds() -> float:
    """Of this process and of what it forked, which tries candidates."""
    return sum(os.times()[:4])
