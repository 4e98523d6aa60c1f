"""Where episodes come from: a trajectory, which is rendered, or a RoboCAS dataset, whose pictures are read."""

from __future__ import annotations

from typing import Any

from robocas_ms3.datasets.lerobot.folder import FolderSource
from robocas_ms3.datasets.lerobot.request import EpisodeSource, OnFrame, Request
from robocas_ms3.datasets.lerobot.schema import whole_rate
from robocas_ms3.datasets.sources.provenance import fingerprint, scene_record, succeeded
from robocas_ms3.datasets.writing.convert import choose, warn_untried
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.datasets.writing.writer import FrameSource, Shown, show_episode
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.motion import sample_stride
from robocas_ms3.recordings.reading import TrajectoryFile

DEFAULT_RATE = 5.0


def open_request(request: Request) -> EpisodeSource:
    """Open what is to be converted.

    Raises:
        DatasetError: it is neither, can't be read, or the options don't suit it.
    """
    return FolderSource(request) if request.path.is_dir() else TrajectorySource(request)


class TrajectorySource:
    """Renders the recordings of a trajectory."""

    def __init__(self, request: Request) -> None:
        """Open the file; the environment is made with the first episode.

        Raises:
            DatasetError: the file is unusable, or the rate does not suit it.
        """
        self._request = request
        self._rate = DEFAULT_RATE if request.rate_hz is None else request.rate_hz
        self._file = TrajectoryFile(request.path, pack=request.pack)
        try:
            self.fps = whole_rate(self._rate)
            self._stride = sample_stride(self._file.control_freq, self._rate)
        except DatasetError:
            self._file.close()
            raise
        self.cameras, self.depth = request.pictures.cameras, request.pictures.depth
        self.size = request.pictures.size
        self._source: FrameSource | None = None
        self._control_mode = ""

    def entries(self) -> list[dict[str, Any]]:
        """The episodes that are wanted; warns where their actions were tried at another rate."""
        found = []
        chosen = choose(self._file, self._request.include_failed)
        warn_untried(self._file, chosen, self._rate)
        for index in chosen:
            episode = self._file.episodes[index]
            entry = {
                "source": index,
                "trajectory": self._file.path.name,
                "trajectory_episode": episode["episode_id"],
                "seed": episode.get("episode_seed"),
                "success": succeeded(episode),
                "target": episode.get("robocas", {}).get("target"),
                "recording": fingerprint(self._file.recording(index, bodies=False)),
            }
            found.append(entry)
        return found

    def sides(self) -> tuple[list[int], list[int]]:
        """None: a trajectory has no sides."""
        return [], []

    def play(self, number: int, on_frame: OnFrame, timing: Timing) -> Shown:
        """Render the recording of this index."""
        with timing.measure("load"):
            recording = self._file.recording(number)
            if self._source is None or recording.control_mode != self._control_mode:
                self._close_source()
                request = self._request
                self._source = request.open_source(self._file.env, recording.control_mode, request.pictures)
                self._control_mode = recording.control_mode
        shown = show_episode(
            recording,
            self._source,
            stride=self._stride,
            embed=None,
            on_frame=lambda step, frame: on_frame(step, frame.rgb, frame.depth),
            timing=timing,
        )
        scene = scene_record(self._file, number, recording, shown.scene, self._rate)
        return Shown(shown.arrays, shown.cameras, scene)

    def close(self) -> None:
        """Close environment and file."""
        self._close_source()
        self._file.close()

    def _close_source(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None
