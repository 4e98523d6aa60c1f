"""Renders a recorded episode, in the other process of a `UnitWorker`."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.writing import rendering
from robocas_ms3.datasets.writing.episode_folder import FolderWriter
from robocas_ms3.datasets.writing.inputs import ConversionInput
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.plans.load import opening_part
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import SeedFiles

if TYPE_CHECKING:
    from robocas_ms3.datasets.writing.render import EnvRenderer


def open_env(env: RecordedEnv, control_mode: str, pictures: Pictures) -> EnvRenderer:
    """Open the environment that recorded an episode."""
    use_one_torch_thread()
    return rendering.open_env(env, control_mode, pictures)


class Renderer:
    """Renders recorded episodes; keeps the environment while the part stays the same."""

    def __init__(self, plan: Plan, open_renderer: rendering.OpenRenderer = open_env) -> None:
        os.environ.setdefault("LP_NUM_THREADS", "1")  # one process per core renders
        self._plan, self._open_renderer = plan, open_renderer
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
            return self._open_renderer(env, control_mode, pictures)

    def _embed(self, texts: list[str]) -> NDArray[np.float32]:
        from robocas_ms3.scenes.language.embed import TextEmbedder

        self._embedder = self._embedder or TextEmbedder()
        # one text at a time: the last bits of an embedding depend on the rest of its batch
        return np.concatenate([self._embedder([text]) for text in texts])

    def close(self) -> None:
        """Close the environment."""
        if self._source is not None:
            self._source.close()
            self._source = None
