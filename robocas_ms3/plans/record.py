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


class Recorder:
    """Records episodes; keeps the environment while the part stays the same."""

    def __init__(self, plan: Plan) -> None:
        use_one_torch_thread()
        self._plan = plan
        self._part: int | None = None
        self._generator: EpisodeGenerator | None = None
        self._model: SceneModel | None = None
        self._layouts: Any = None

    def run(self, files: SeedFiles) -> dict[str, Any]:
        """Write the layout of a seed and record its episode, as the plan asks; return fields of its `Outcome`."""
        start = _cpu_seconds()
        if self._part != files.part:
            self.close()
            with opening_part(self._plan, files.part):
                self._open(recording_settings(self._plan, files.part))
            self._part = files.part
        try:
            if self._model is not None:  # as the environment samples it
                layout = self._layouts(files.seed, files.seed)
                write_frozen(files.layout, self._model.object_pack.objects, {files.seed: layout})
            result = self._record(files, self._generator) if self._generator else {"success": True}
        except LayoutError as error:
            result = {"success": False, "failures": [f"layout: {error.what}"]}
        return {**result, "record_seconds": round(_cpu_seconds() - start, 2)}

    def _open(self, settings: EpisodeSettings) -> None:
        if self._plan.makes_layouts:
            config, robot = load_config_of(TASKS[settings.task], settings.config), find_robot(settings.robot)
            pack = load_pack(settings.pack)
            self._model = SceneModel.load(config, pack, load_pack("builtin"), robot=robot.description)
            self._layouts = layout_source(self._model, settings.layouts)
        if self._plan.makes_demonstrations:
            self._generator = EpisodeGenerator(settings)

    def _record(self, files: SeedFiles, generator: EpisodeGenerator) -> dict[str, Any]:
        if not files.recording.is_file():  # otherwise its process died after it had written the file
            tmp = files.folder / ".recording.tmp.h5"
            result = generator.generate(files.seed, files.folder, tmp.stem)
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

    def close(self) -> None:
        """Close the environments."""
        if self._generator is not None:
            self._generator.close()
        self._part = self._generator = self._model = None


def _remove_times(path: Path) -> None:
    """Remove from a recording's JSON what a clock measured: every machine then writes the same bytes."""
    content = read_json(path)
    for episode in content["episodes"]:
        episode["robocas"].pop("seconds", None)
    write_json(path, content)


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of its forked branches."""
    return sum(os.times()[:4])
