"""Makes the layout of a seed and records its episode, in a process of a slot."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.demos.episode import EpisodeSettings
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.recordings.entries import read_json
from robocas_ms3.plans.layouts import LayoutMaker
from robocas_ms3.plans.opening import opening
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import Task


def settings_of(plan: Plan, part: int) -> EpisodeSettings:
    """How a part's episodes are recorded."""
    one = plan.parts[part]
    assert one.config is not None  # a loaded plan names all
    rate = int(plan.rate) if plan.rate == int(plan.rate) else 5  # actions are tried as the dataset will hold them
    chosen = {"control_freq": plan.control_freq, "replay_rate": rate, **plan.recording.chosen()}
    return EpisodeSettings(one.task, one.config, one.pack, **chosen)


class Records:
    """Records episodes; keeps the environment from one to the next of the same part."""

    def __init__(self, plan: Plan) -> None:
        use_one_torch_thread()
        self._plan = plan
        self._settings: EpisodeSettings | None = None
        self._generator: EpisodeGenerator | None = None
        self._layouts: LayoutMaker | None = None

    def run(self, task: Task) -> dict[str, Any]:
        """Make a seed's layout and record its episode, whatever is asked for, and say what came of it."""
        begun = _cpu_seconds()
        self._turn_to(task.part)
        found = self._make_layout(task)
        if found["success"] and self._plan.makes_demonstrations:
            found = self._record(task)
        return {**found, "record_seconds": round(_cpu_seconds() - begun, 2)}

    def _make_layout(self, task: Task) -> dict[str, Any]:
        if self._layouts is not None:
            try:
                self._layouts.write(task)
            except LayoutError as error:
                return {"success": False, "failures": [f"layout: {error.what}"]}
        return {"success": True}

    def _record(self, task: Task) -> dict[str, Any]:
        assert self._generator is not None
        if not task.recording.is_file():  # else its process died after it was there
            made = task.recording.with_name(f".{task.recording.stem}.tmp.h5")
            result = self._generator.generate(task.seed, task.folder, made.stem)
            if not result.success:
                return {"success": False, "failures": [f"{one.stage}: {one.reason}" for one in result.failures]}
            _forget_clock(made)
            os.replace(made.with_suffix(".json"), task.recording.with_suffix(".json"))
            os.replace(made, task.recording)
        said = read_json(task.recording)["episodes"][0]
        return {
            "success": True,
            "steps": said["elapsed_steps"],
            "failures": said["robocas"]["failed_attempts"],
        }

    def _turn_to(self, part: int) -> None:
        settings = settings_of(self._plan, part)
        if settings == self._settings:
            return
        self.close()
        with opening(self._plan, part):
            self._layouts = LayoutMaker(settings) if self._plan.makes_layouts else None
            self._generator = EpisodeGenerator(settings) if self._plan.makes_demonstrations else None
        self._settings = settings

    def close(self) -> None:
        """Close the environments."""
        if self._generator is not None:
            self._generator.close()
        self._settings = self._generator = None


def _forget_clock(recording: Path) -> None:
    """Leave out of a recording what a clock said, so that whoever makes it makes the same."""
    path = recording.with_suffix(".json")
    content = read_json(recording)
    for episode in content["episodes"]:
        episode["robocas"].pop("seconds", None)
    write_json(path, content)


def _cpu_seconds() -> float:
    """Of this process and of what it forked, which tries candidates."""
    return sum(os.times()[:4])
