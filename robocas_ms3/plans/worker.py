"""Does work units: records the episode of each seed and renders it at once, in processes that may die.

One process records an episode, the other one renders it; both keep the environment while the part stays the same.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import (
    DatasetError,
    LayoutError,
    PlanError,
    PlanningError,
    RobocasError,
    SimulationError,
    WorkerCrashError,
    WorkerStartError,
)
from robocas_ms3.core.files import remove, write_json
from robocas_ms3.core.output_folder import remove_leftovers
from robocas_ms3.core.text import format_error
from robocas_ms3.core.workers import Limits, WorkerPool, use_one_torch_thread
from robocas_ms3.datasets.conversion import rendered_source
from robocas_ms3.datasets.conversion.conversion_input import ConversionInput
from robocas_ms3.datasets.conversion.episode_folder import FolderWriter
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.trajectory_json import read_json
from robocas_ms3.plans.folder import Outcome, PlanFolder, SeedFiles, WorkUnit
from robocas_ms3.plans.load import part_error_context, recording_settings
from robocas_ms3.plans.plan import Plan
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.config import load_config_for
from robocas_ms3.scenes.layout_table import write_frozen_layouts
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.task_specs import TASKS

if TYPE_CHECKING:
    from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer
    from robocas_ms3.demos.generator import EpisodeGenerator

TRIES = 2
"""How often a seed is tried whose process dies, before it is left out."""
_OF_A_SEED = (LayoutError, PlanningError, SimulationError, DatasetError)  # other errors of ours affect all seeds


class Recorder:
    """Samples the layouts of seeds and records their episodes."""

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
            with part_error_context(self._plan, files.part):
                self._open(files.part)
            self._part = files.part
        try:
            if self._model is not None:  # as the environment samples it
                layout = self._layouts(files.seed, files.seed)
                write_frozen_layouts(files.layout, self._model.object_pack.objects, {files.seed: layout})
            result = self._record(files, self._generator) if self._generator else {"success": True}
        except LayoutError as error:
            result = {"success": False, "failures": [f"layout: {error.what}"]}
        return {**result, "record_seconds": round(_cpu_seconds() - start, 2)}

    def _open(self, part: int) -> None:
        settings = recording_settings(self._plan, part)
        if "layouts" in self._plan.stages:
            from robocas_ms3.scenes.cache import layout_source

            config, robot = load_config_for(TASKS[settings.task], settings.config), find_robot(settings.robot)
            pack = load_pack(settings.pack)
            self._model = SceneModel.load(config, pack, load_pack("builtin"), robot=robot.description)
            self._layouts = layout_source(self._model, settings.layouts)
        if "demonstrations" in self._plan.stages:
            from robocas_ms3.demos.generator import EpisodeGenerator  # with the simulator

            self._generator = EpisodeGenerator(settings)

    def _record(self, files: SeedFiles, generator: EpisodeGenerator) -> dict[str, Any]:
        if not files.recording.is_file():  # otherwise its process died after it had written the file
            tmp = files.folder / ".recording.tmp.h5"
            result = generator.generate(files.seed, files.folder, tmp.stem)
            if not result.success:
                return {"success": False, "failures": [f"{each.stage}: {each.reason}" for each in result.failures]}
            content = read_json(tmp)
            for episode in content["episodes"]:
                episode["robocas"].pop("seconds", None)  # by a clock: every machine writes the same bytes
            write_json(files.recording.with_suffix(".json"), content)
            tmp.with_suffix(".json").unlink()
            os.replace(tmp, files.recording)
        episode = read_json(files.recording)["episodes"][0]
        return {
            "success": True,
            "steps": episode["elapsed_steps"],
            "failures": episode["robocas"]["failed_attempts"],
        }

    def close(self) -> None:
        if self._generator is not None:
            self._generator.close()
        self._part = self._generator = self._model = None


class Renderer:
    """Renders recorded episodes."""

    def __init__(self, plan: Plan) -> None:
        os.environ.setdefault("LP_NUM_THREADS", "1")  # one process per core renders
        self._plan = plan
        self._part: int | None = None
        self._source: rendered_source.RenderedSource | None = None
        self._embedder: Any = None

    def run(self, files: SeedFiles) -> dict[str, Any]:
        """Render the episode of a seed; return fields of its `Outcome`."""
        start = time.process_time()
        if not files.episode.is_dir():  # otherwise its process died after it had written the folder
            recording = ConversionInput(self._source_of(files), self._plan.images.chosen())
            embed = self._embed if self._plan.embeddings else None
            FolderWriter(files.folder, embed).write(0, recording, 0)
        return {"render_seconds": round(time.process_time() - start, 2)}

    def open_env(self, env: RecordedEnv, control_mode: str, image_options: ImageOptions) -> EnvRenderer:
        """Open the environment that recorded an episode."""
        use_one_torch_thread()
        return rendered_source.open_env(env, control_mode, image_options)

    def _source_of(self, files: SeedFiles) -> rendered_source.RenderedSource:
        if self._source is None or self._part != files.part:
            self.close()
            self._part = files.part
            self._source = rendered_source.RenderedSource(
                files.recording,
                rate_hz=self._plan.rate,
                image_options=self._plan.images.chosen(),
                pack=self._plan.parts[files.part].pack,
                open_renderer=self._open,
            )
        else:
            self._source.switch_file(files.recording)
        return self._source

    def _open(self, env: RecordedEnv, control_mode: str, image_options: ImageOptions) -> EnvRenderer:
        assert self._part is not None
        with part_error_context(self._plan, self._part):
            return self.open_env(env, control_mode, image_options)

    def _embed(self, texts: list[str]) -> NDArray[np.float32]:
        from robocas_ms3.scenes.language.embed import TextEmbedder

        self._embedder = self._embedder or TextEmbedder()
        # one text at a time: the last bits of an embedding depend on the rest of its batch
        return np.concatenate([self._embedder([text]) for text in texts])

    def close(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None


class WorkUnitWorker:
    """Does one work unit after the other, by two processes that are kept from unit to unit.

    One process records an episode, the other one renders it: a process with a renderer can't fork, as planning does.
    """

    def __init__(self, folder: PlanFolder) -> None:
        self._folder, self._plan, self._output = folder, folder.plan, folder.open(shared=True)
        chosen = self._plan.limits
        limits = Limits(chosen.record_seconds, chosen.memory_gb), Limits(chosen.render_seconds, chosen.memory_gb)
        self._record = WorkerPool(partial(Recorder, self._plan), 1, limits=limits[0], retries=0)
        self._render = WorkerPool(partial(Renderer, self._plan), 1, limits=limits[1], retries=0)

    def do(self, unit: WorkUnit) -> None:
        """Do the seeds of a unit that are not done; an error is one that every seed would meet."""
        for _ in self.seeds(unit):
            pass

    def seeds(self, unit: WorkUnit) -> Iterator[SeedFiles]:
        """Do the seeds of a unit that are not done; yield the files of each, which are complete."""
        if self._folder.outcomes(unit) is not None:
            return
        for seed in unit.seeds(self._plan):
            files = self._folder.files(unit, seed)
            if files.outcome() is None:
                self._output.check_record()
                with files.temporary() as tmp:
                    outcome = self._outcome(tmp)
                    if not outcome.success:
                        for path in tmp.folder.iterdir():
                            remove(path)
                    tmp.write(outcome)
                    self._output.check_record()  # --overwrite may have started another plan
                yield files
        self._folder.complete(unit)

    def _outcome(self, files: SeedFiles) -> Outcome:
        crashes = list[str]()
        result = self._survive(self._record, "record", files, crashes)
        if result["success"] and "datasets" in self._plan.stages:
            result |= self._survive(self._render, "render", files, crashes)
        size = files.size() if result["success"] else 0
        return Outcome(seed=files.seed, end_time=time.time(), size=size, crashes=crashes, **result)

    def _survive(
        self, process: WorkerPool[SeedFiles, dict[str, Any]], stage: str, files: SeedFiles, crashes: list[str]
    ) -> dict[str, Any]:
        """Do a stage of an episode; retry it when its process dies, up to `TRIES`."""
        for _ in range(TRIES):
            try:
                return process.run(files)
            except (WorkerStartError, ImportError) as failed:
                raise PlanError("a process could not start", found=failed) from failed
            except WorkerCrashError as crash:
                reason = f"{crash.found}"
            except Exception as error:
                if not _is_of_a_seed(error):
                    raise
                reason = format_error(error, 200)
            crashes.append(f"{stage}: {reason}")
            remove_leftovers(files.folder)
        return {"success": False, "failures": [crashes[-1]]}

    def stop(self) -> None:
        """Kill the processes; `do` in another thread raises `CancelledError`."""
        self._record.stop()
        self._render.stop()

    def close(self) -> None:
        self.stop()
        self._record.close()
        self._render.close()


def _is_of_a_seed(error: Exception) -> bool:
    """Return whether an error is due to a seed: its scene or files, a bug that it has found, memory that was missing.

    Errors of the disk, the system or the installation are not: all seeds of a machine would be left out.
    """
    if isinstance(error, RobocasError):
        return isinstance(error, _OF_A_SEED)
    return not isinstance(error, CancelledError | OSError)


def _cpu_seconds() -> float:
    return sum(os.times()[:4])
