"""Run work units: record and render the episode of each seed, in worker processes that may crash.

One process records, another process renders. Both keep their environment until a seed of another plan part follows.
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
from robocas_ms3.core.files import delete_path, write_json
from robocas_ms3.core.output_folder import remove_temporary_files
from robocas_ms3.core.text import format_error
from robocas_ms3.core.workers import Limits, WorkerPool, hide_cuda, use_one_torch_thread
from robocas_ms3.datasets.conversion import rendered_source
from robocas_ms3.datasets.conversion.conversion_input import ConversionInput
from robocas_ms3.datasets.conversion.episode_folder import FolderWriter
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.demos.candidates.records import candidates_file_name
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.trajectory_json import read_json
from robocas_ms3.plans.folder import Outcome, PlanFolder, SeedFiles, WorkUnit
from robocas_ms3.plans.load import convert_part_errors, recording_settings
from robocas_ms3.plans.plan import Plan
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.config import load_config_for
from robocas_ms3.scenes.layout_table import write_frozen_layouts
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.task_specs import TASKS

if TYPE_CHECKING:
    from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer
    from robocas_ms3.demos.generator import EpisodeGenerator

MAX_CRASHES = 2
"""Number of crashes in a stage of a seed after which the seed is skipped."""
_SEED_ERRORS = (LayoutError, PlanningError, SimulationError, DatasetError)  # other RobocasErrors affect all seeds


class Recorder:
    """Sample the layouts of seeds and record their episodes."""

    def __init__(self, plan: Plan) -> None:
        use_one_torch_thread()
        hide_cuda()
        self._plan = plan
        self._part: int | None = None
        self._generator: EpisodeGenerator | None = None
        self._model: SceneModel | None = None
        self._layouts: Any = None

    def run(self, files: SeedFiles) -> dict[str, Any]:
        """Write the layout and the recording of a seed, if the plan has these stages.

        Returns:
            Fields of the `Outcome` of the seed.
        """
        start = _cpu_seconds()
        if self._part != files.part:
            self.close()
            with convert_part_errors(self._plan, files.part):
                self._open_part(files.part)
            self._part = files.part
        try:
            if self._model is not None:  # the environment samples the same layout
                layout = self._layouts(files.seed, files.seed)
                write_frozen_layouts(files.layout_path, self._model.object_pack.objects, {files.seed: layout})
            result = self._record(files, self._generator) if self._generator else {"success": True}
        except LayoutError as error:
            result = {"success": False, "failures": [f"layout: {error.what}"]}
        return {**result, "record_seconds": round(_cpu_seconds() - start, 2)}

    def _open_part(self, part: int) -> None:
        settings = recording_settings(self._plan, part)
        if "layouts" in self._plan.stages:
            from robocas_ms3.scenes.cache import make_layout_source

            config, robot = load_config_for(TASKS[settings.task], settings.config), find_robot(settings.robot)
            pack = load_pack(settings.pack)
            self._model = SceneModel.load(config, pack, load_pack("builtin"), robot=robot.description)
            self._layouts = make_layout_source(self._model, settings.layouts)
        if "demonstrations" in self._plan.stages:
            from robocas_ms3.demos.generator import EpisodeGenerator  # imports the simulator

            self._generator = EpisodeGenerator(settings)

    def _record(self, files: SeedFiles, generator: EpisodeGenerator) -> dict[str, Any]:
        if not files.recording_path.is_file():  # otherwise a process crashed after writing the file
            tmp = files.folder / ".recording.tmp.h5"
            result = generator.generate(files.seed, files.folder, tmp.stem)
            if not result.success:
                return {"success": False, "failures": [f"{each.stage}: {each.reason}" for each in result.failures]}
            content = read_json(tmp)
            for episode in content["episodes"]:
                episode["robocas"].pop("seconds", None)  # wall-clock times differ between machines
            write_json(files.recording_path.with_suffix(".json"), content)
            tmp.with_suffix(".json").unlink()
            if generator.settings.record_candidates:
                os.replace(files.folder / candidates_file_name(tmp.stem), files.candidates_path)
            os.replace(tmp, files.recording_path)
        episode = read_json(files.recording_path)["episodes"][0]
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
    """Render recorded episodes."""

    def __init__(self, plan: Plan) -> None:
        os.environ.setdefault("LP_NUM_THREADS", "1")  # one rendering process per core
        self._plan = plan
        self._part: int | None = None
        self._source: rendered_source.RenderedSource | None = None
        self._embedder: Any = None

    def run(self, files: SeedFiles) -> dict[str, Any]:
        """Render the recorded episode of a seed; return fields of the `Outcome` of the seed."""
        start = time.process_time()
        if not files.episode_path.is_dir():  # otherwise a process crashed after writing the folder
            recording = ConversionInput(self._open_source(files), self._plan.images.image_options())
            embed = self._embed if self._plan.embeddings else None
            FolderWriter(files.folder, embed).write(0, recording, 0)
        return {"render_seconds": round(time.process_time() - start, 2)}

    def open_env(self, env: RecordedEnv, control_mode: str, image_options: ImageOptions) -> EnvRenderer:
        """Open the environment that recorded an episode, with a renderer."""
        use_one_torch_thread()
        return rendered_source.open_env_renderer(env, control_mode, image_options)

    def _open_source(self, files: SeedFiles) -> rendered_source.RenderedSource:
        if self._source is None or self._part != files.part:
            self.close()
            self._part = files.part
            self._source = rendered_source.RenderedSource(
                files.recording_path,
                rate_hz=self._plan.rate,
                image_options=self._plan.images.image_options(),
                pack=self._plan.parts[files.part].pack,
                open_renderer=self._open_renderer,
            )
        else:
            self._source.switch_file(files.recording_path)
        return self._source

    def _open_renderer(self, env: RecordedEnv, control_mode: str, image_options: ImageOptions) -> EnvRenderer:
        assert self._part is not None
        with convert_part_errors(self._plan, self._part):
            return self.open_env(env, control_mode, image_options)

    def _embed(self, texts: list[str]) -> NDArray[np.float32]:
        from robocas_ms3.scenes.language.embed import TextEmbedder

        self._embedder = self._embedder or TextEmbedder()
        # one text at a time: rounding depends on the other texts of a batch
        return np.concatenate([self._embedder([text]) for text in texts])

    def close(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None


class WorkUnitWorker:
    """Run work units one after the other, with two processes that stay alive between work units.

    One process records, the other process renders. Planning forks its process, and a process with an open renderer
    cannot be forked.
    """

    def __init__(self, folder: PlanFolder) -> None:
        self._folder, self._plan, self._output = folder, folder.plan, folder.open_output(shared=True)
        chosen = self._plan.limits
        limits = Limits(chosen.record_seconds, chosen.memory_gb), Limits(chosen.render_seconds, chosen.memory_gb)
        self._record = WorkerPool(partial(Recorder, self._plan), 1, limits=limits[0], retries=0)
        self._render = WorkerPool(partial(Renderer, self._plan), 1, limits=limits[1], retries=0)

    def run(self, unit: WorkUnit) -> None:
        """Run the missing seeds of a work unit; raise an error if it affects all seeds."""
        for _ in self.run_seeds(unit):
            pass

    def run_seeds(self, unit: WorkUnit) -> Iterator[SeedFiles]:
        """Run the missing seeds of a work unit; yield the paths of each seed when its files are complete."""
        if self._folder.read_outcomes(unit) is not None:
            return
        for seed in unit.seeds(self._plan):
            files = self._folder.seed_files(unit, seed)
            if files.read_outcome() is None:
                self._output.check_record()
                with files.temporary_files() as tmp:
                    outcome = self._run_seed(tmp)
                    if not outcome.success:
                        for path in tmp.folder.iterdir():
                            delete_path(path)
                    tmp.write_outcome(outcome)
                    self._output.check_record()  # a run with --overwrite may have replaced the plan
                yield files
        self._folder.write_outcomes(unit)

    def _run_seed(self, files: SeedFiles) -> Outcome:
        crashes = list[str]()
        result = self._run_stage(self._record, "record", files, crashes)
        if result["success"] and "datasets" in self._plan.stages:
            result |= self._run_stage(self._render, "render", files, crashes)
        size = files.size() if result["success"] else 0
        return Outcome(seed=files.seed, end_time=time.time(), size=size, crashes=crashes, **result)

    def _run_stage(
        self, process: WorkerPool[SeedFiles, dict[str, Any]], stage: str, files: SeedFiles, crashes: list[str]
    ) -> dict[str, Any]:
        """Run a stage of a seed; run it again if the process crashes or fails, at most `MAX_CRASHES` times in all.

        Returns:
            Fields of the `Outcome` of the seed.
        """
        for _ in range(MAX_CRASHES):
            try:
                return process.run(files)
            except (WorkerStartError, ImportError) as failed:
                fix = "Run robocas doctor."
                raise PlanError("a worker process of the plan cannot start", found=failed, fix=fix) from failed
            except WorkerCrashError as crash:
                reason = f"{crash.found}"
            except Exception as error:
                if not _is_seed_error(error):
                    raise
                reason = format_error(error, 200)
            crashes.append(f"{stage}: {reason}")
            remove_temporary_files(files.folder)
        return {"success": False, "failures": [crashes[-1]]}

    def stop(self) -> None:
        """Kill the two processes; a `run` that waits in another thread raises `CancelledError`."""
        self._record.stop()
        self._render.stop()

    def close(self) -> None:
        self.stop()
        self._record.close()
        self._render.close()


def _is_seed_error(error: Exception) -> bool:
    """Return whether an error affects only one seed: an error in its scene or its files, a bug, or a lack of memory.

    Errors of the disk, the system or the installation affect all seeds of a machine, so no seed is skipped for them.
    """
    if isinstance(error, RobocasError):
        return isinstance(error, _SEED_ERRORS)
    return not isinstance(error, CancelledError | OSError)


def _cpu_seconds() -> float:
    return sum(os.times()[:4])
