"""Samples the layout of a seed and records its episode, in a process of a `UnitWorker`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.recordings.entries import read_json
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.plans.load import opening_part, recording_settings
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import SeedFiles
from robocas_ms3.robots.table import find_robot
from robocas_ms3.scenes.cache import layout_source
from robocas_ms3.scenes.config import load_config_of
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.table import write_frozen
from robocas_ms3.scenes.task_specs import TASKS


class LayoutMaker:
    """Samples the layouts that the environment of a task configuration has.

    Args:
        settings: of the episodes.
    """

    def __init__(self, settings: EpisodeSettings) -> None:
        config, robot = load_config_of(TASKS[settings.task], settings.config), find_robot(settings.robot)
        model = SceneModel.load(config, load_pack(settings.pack), load_pack("builtin"), robot=robot.description)
        self._names = model.object_pack.objects
        self._layouts = layout_source(model, settings.layouts)

    def write(self, files: SeedFiles) -> None:
        """Write the layout of a seed.

        Raises:
            LayoutError: the seed has none.
        """
        write_frozen(files.layout, self._names, {files.seed: self._layouts(files.seed, files.seed)})


class Recorder:
    """Records episodes; keeps the environment while the part stays the same."""

    def __init__(self, plan: Plan) -> None:
        use_one_torch_thread()
        self._plan = plan
        self._settings: EpisodeSettings | None = None
        self._generator: EpisodeGenerator | None = None
        self._layouts: LayoutMaker | None = None

    def run(self, files: SeedFiles) -> dict[str, Any]:
        """Write the layout of a seed and record its episode, as the plan asks; return fields of its `Outcome`."""
        start = _cpu_seconds()
        self._open(files.part)
        result = self._make_layout(files)
        if result["success"] and self._plan.makes_demonstrations:
            result = self._record(files)
        return {**result, "record_seconds": round(_cpu_seconds() - start, 2)}

    def _make_layout(self, files: SeedFiles) -> dict[str, Any]:
        if self._layouts is not None:
            try:
                self._layouts.write(files)
            except LayoutError as error:
                return {"success": False, "failures": [f"layout: {error.what}"]}
        return {"success": True}

    def _record(self, files: SeedFiles) -> dict[str, Any]:
        assert self._generator is not None
        if not files.recording.is_file():  # otherwise its process died after it had written the file
            tmp = files.folder / ".recording.tmp.h5"
            result = self._generator.generate(files.seed, files.folder, tmp.stem)
            if not result.success:
                return {"success": False, "failures": [f"{each.stage}: {each.reason}" for each in result.failures]}
            _remove_times(tmp.with_suffix(".json"))
            os.replace(tmp.with_suffix(".json"), files.recording.with_suffix(".json"))
            os.replace(tmp, files.recording)
        episode = read_json(files.recording)["episodes"][0]
        return {
            "success": True,
            "steps": episode["elapsed_steps"],
            "failures": episode["robocas"]["failed_attempts"],
        }

    def _open(self, part: int) -> None:
        settings = recording_settings(self._plan, part)
        if settings == self._settings:
            return
        self.close()
        with opening_part(self._plan, part):
            self._layouts = LayoutMaker(settings) if self._plan.makes_layouts else None
            self._generator = EpisodeGenerator(settings) if self._plan.makes_demonstrations else None
        self._settings = settings

    def close(self) -> None:
        """Close the environments."""
        if self._generator is not None:
            self._generator.close()
        self._settings = self._generator = None


def _remove_times(path: Path) -> None:
    """Remove from a recording's JSON what a clock measured: every machine then writes the same bytes."""
    content = read_json(path)
    for episode in content["episodes"]:
        episode["robocas"].pop("seconds", None)
    write_json(path, content)


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of its forked branches."""
    return sum(os.times()[:4])
