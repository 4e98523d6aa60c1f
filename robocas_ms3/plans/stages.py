"""The stages of an episode, each in a process of a `UnitWorker`: one records it, the other renders it.

They keep the environment while the part stays the same.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.writing import rendering
from robocas_ms3.datasets.writing.episode_folder import FolderWriter
from robocas_ms3.datasets.writing.inputs import ConversionInput
from robocas_ms3.demos.recordings.entries import read_json
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.plans.folder import SeedFiles
from robocas_ms3.plans.load import opening_part, recording_settings
from robocas_ms3.plans.plan import Plan
from robocas_ms3.robots.table import find_robot
from robocas_ms3.scenes.config import load_config_of
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.table import write_frozen
from robocas_ms3.scenes.task_specs import TASKS

if TYPE_CHECKING:
    from robocas_ms3.datasets.writing.render import EnvRenderer
    from robocas_ms3.demos.generator import EpisodeGenerator


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
            with opening_part(self._plan, files.part):
                self._open(files.part)
            self._part = files.part
        try:
            if self._model is not None:  # as the environment samples it
                layout = self._layouts(files.seed, files.seed)
                write_frozen(files.layout, self._model.object_pack.objects, {files.seed: layout})
            result = self._record(files, self._generator) if self._generator else {"success": True}
        except LayoutError as error:
            result = {"success": False, "failures": [f"layout: {error.what}"]}
        return {**result, "record_seconds": round(_cpu_seconds() - start, 2)}

    def _open(self, part: int) -> None:
        settings = recording_settings(self._plan, part)
        if self._plan.makes_layouts:
            from robocas_ms3.scenes.cache import layout_source

            config, robot = load_config_of(TASKS[settings.task], settings.config), find_robot(settings.robot)
            pack = load_pack(settings.pack)
            self._model = SceneModel.load(config, pack, load_pack("builtin"), robot=robot.description)
            self._layouts = layout_source(self._model, settings.layouts)
        if self._plan.makes_demonstrations:
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
        self._source: rendering.RenderedSource | None = None
        self._embedder: Any = None

    def run(self, files: SeedFiles) -> dict[str, Any]:
        """Render the episode of a seed; return fields of its `Outcome`."""
        start = time.process_time()
        if not files.episode.is_dir():  # otherwise its process died after it had written the folder
            recording = ConversionInput(self._source_of(files), self._plan.pictures.chosen())
            embed = self._embed if self._plan.embeddings else None
            FolderWriter(files.folder, embed).write(0, recording, 0)
        return {"render_seconds": round(time.process_time() - start, 2)}

    def open_env(self, env: RecordedEnv, control_mode: str, pictures: Pictures) -> EnvRenderer:
        """Open the environment that recorded an episode."""
        use_one_torch_thread()
        return rendering.open_env(env, control_mode, pictures)

    def _source_of(self, files: SeedFiles) -> rendering.RenderedSource:
        if self._source is None or self._part != files.part:
            self.close()
            self._part = files.part
            self._source = rendering.RenderedSource(
                files.recording,
                rate_hz=self._plan.rate,
                pictures=self._plan.pictures.chosen(),
                pack=self._plan.parts[files.part].pack,
                open_renderer=self._open,
            )
        else:
            self._source.turn_to(files.recording)
        return self._source

    def _open(self, env: RecordedEnv, control_mode: str, pictures: Pictures) -> EnvRenderer:
        assert self._part is not None
        with opening_part(self._plan, self._part):
            return self.open_env(env, control_mode, pictures)

    def _embed(self, texts: list[str]) -> NDArray[np.float32]:
        from robocas_ms3.scenes.language.embed import TextEmbedder

        self._embedder = self._embedder or TextEmbedder()
        # one text at a time: the last bits of an embedding depend on the rest of its batch
        return np.concatenate([self._embedder([text]) for text in texts])

    def close(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of its forked branches."""
    return sum(os.times()[:4])
