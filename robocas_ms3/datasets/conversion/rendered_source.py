"""Episode source that renders the recordings of a trajectory file."""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.episode_source import StepImages
from robocas_ms3.datasets.sources.provenance import make_entry_without_fingerprint, make_recording_entry, make_scene
from robocas_ms3.datasets.sources.trajectory import RecordedEpisode, TrajectorySource
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.motion import sample_states
from robocas_ms3.demos.recordings.trajectory_file import Recording, TrajectoryFile
from robocas_ms3.robots.camera_models import CameraModel

if TYPE_CHECKING:
    from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer

OpenRenderer = Callable[[RecordedEnv, str, ImageOptions], "EnvRenderer"]
"""(environment of the recording, its control mode, images to render) -> renderer."""


def open_env_renderer(env: RecordedEnv, control_mode: str, image_options: ImageOptions) -> EnvRenderer:
    from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer

    return EnvRenderer(env, control_mode, image_options)


class RenderedSource(TrajectorySource):
    """Trajectory file whose episodes, including failed ones, are rendered in one environment."""

    def __init__(
        self,
        path: Path,
        *,
        rate_hz: float | None,
        image_options: ImageOptions,
        pack: str | Path | None = None,
        open_renderer: OpenRenderer = open_env_renderer,
    ) -> None:
        super().__init__(path, rate_hz=rate_hz, include_failed=True, pack=pack)
        self.image_options = image_options.select_cameras([camera.name for camera in self.file.env.cameras()], path)
        self.cameras, self.has_depth = self.image_options.cameras, image_options.depth
        self._pack, self._open_renderer = pack, open_renderer
        self._renderer: EnvRenderer | None = None
        self._control_mode = ""

    def switch_file(self, path: Path) -> None:
        """Continue with another trajectory file of the same environment, which stays open."""
        env, control_freq = self.file.env, self.file.control_freq
        with TrajectoryFile(path, pack=self._pack) as file:
            if (file.env, file.control_freq) != (env, control_freq):
                what = "this file was recorded in another environment"
                raise DatasetError(what, where=path, expected=f"the environment of {self.root}")
        super().__init__(path, rate_hz=self.rate_hz, include_failed=True, pack=self._pack)

    def conversion_entry(self, number: int) -> dict[str, Any]:
        with self.file.reopen() as file:
            try:
                return make_recording_entry(file, number)
            except DatasetError:
                return make_entry_without_fingerprint(file, number)

    def list_texts(self, number: int) -> list[str]:
        """Return the instruction of an episode and the texts of its sub-goals."""
        entry = self.episode_entry(number)
        return [entry.instruction, *(goal.goal_description for goal in entry.subgoals)]

    def episode(self, number: int) -> RenderedEpisode:
        recording = self.recording(number)
        samples = sample_states(recording.control_steps, self.stride)
        if len(samples) > schema.MAX_STEPS:
            where = f"episode {recording.episode_id}"
            raise DatasetError(
                "too many steps", where=where, expected=f"at most {schema.MAX_STEPS}", found=len(samples)
            )
        if self._renderer is None or recording.control_mode != self._control_mode:
            self.close()
            self._renderer = self._open_renderer(self.file.env, recording.control_mode, self.image_options)
            self._control_mode = recording.control_mode
        self._renderer.load_scene(recording)
        return RenderedEpisode(self, number, recording, self._renderer)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class RenderedEpisode(RecordedEpisode):
    """Episode of a `RenderedSource`; its camera models are valid after its images have been rendered."""

    def __init__(self, source: RenderedSource, number: int, recording: Recording, renderer: EnvRenderer) -> None:
        super().__init__(source, number)
        self.cameras = source.cameras
        self._recording, self._renderer = recording, renderer

    def recording(self, *, bodies: bool = True) -> Recording:
        return self._recording

    def images(self, image_options: ImageOptions) -> Generator[StepImages, None, None]:
        samples = sample_states(self._recording.control_steps, self._source.stride)
        yield from self._renderer.frames(self._recording, samples)

    @property
    def scene(self) -> dict[str, Any]:
        source, rendered = self._source, self._renderer.scene()
        return make_scene(source.file, self._number, self._recording, rendered, source.rate_hz)

    @cached_property
    def _models(self) -> dict[str, CameraModel]:
        return self._renderer.cameras()

    def camera(self, name: str) -> CameraModel:
        return self._models[name]
