"""Renders a recorded episode, in another process of a slot."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.writing.episode_folder import FolderWriter
from robocas_ms3.datasets.writing.inputs import ConversionInput
from robocas_ms3.datasets.writing.rendering import OpenRenderer, RenderedSource, Renderer, open_env
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.plans.opening import opening
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import Task


class Renders:
    """Renders recorded episodes; keeps the environment from one to the next of the same part."""

    def __init__(self, plan: Plan, open_renderer: OpenRenderer = open_env) -> None:
        os.environ.setdefault("LP_NUM_THREADS", "1")  # as many processes render as there are cores
        if open_renderer is open_env:
            from robocas_ms3.datasets.writing.render import require_renderer

            use_one_torch_thread()
            require_renderer()  # where it is missing, it is for all episodes
        self._plan, self._open_renderer = plan, open_renderer
        self._part: int | None = None
        self._source: RenderedSource | None = None
        self._embedder: Any = None

    def run(self, task: Task) -> dict[str, Any]:
        """Render a seed's episode, and say what it takes."""
        begun = time.process_time()
        if not task.episode.is_dir():  # else its process died after it was there
            given = ConversionInput(self._source_of(task), self._plan.pictures.chosen())
            embed = self._embed if self._plan.embeddings else None
            FolderWriter(task.episode.parent, embed).write(0, given, 0)
        return {"render_seconds": round(time.process_time() - begun, 2)}

    def _source_of(self, task: Task) -> RenderedSource:
        if self._source is None or self._part != task.part:
            self.close()
            self._part, self._source = (
                task.part,
                RenderedSource(
                    task.recording,
                    rate_hz=self._plan.rate,
                    pictures=self._plan.pictures.chosen(),
                    pack=self._plan.parts[task.part].pack,
                    open_renderer=self._open,
                ),
            )
        else:
            self._source.turn_to(task.recording)
        return self._source

    def _open(self, env: RecordedEnv, control_mode: str, pictures: Pictures) -> Renderer:
        assert self._part is not None
        with opening(self._plan, self._part):
            return self._open_renderer(env, control_mode, pictures)

    def _embed(self, texts: list[str]) -> NDArray[np.float32]:
        from robocas_ms3.scenes.language.embed import TextEmbedder

        self._embedder = self._embedder or TextEmbedder()
        # one at a time: in a batch the last bits depend on the others, and which are known already on who did what
        return np.concatenate([self._embedder([text]) for text in texts])

    def close(self) -> None:
        """Close the environment."""
        if self._source is not None:
            self._source.close()
            self._source = None
