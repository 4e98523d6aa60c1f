"""Settings of a conversion, and its result: written episodes and the time that they took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.workers import Limits
from robocas_ms3.datasets.formats import format_of
from robocas_ms3.datasets.lerobot.variants import NEWEST
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.writing.rendering import OpenRenderer, open_env

Codec = Literal["h264", "av1"]
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class ConversionSettings:
    """What is converted into which folder, and how; can be sent to another process.

    Attributes:
        source: a trajectory file ``F.h5`` with ``F.json`` next to it, or the folder of a dataset.
        out: folder of the dataset to write.
        rate_hz: steps per second; divides the control frequency; None: 5, or the rate of the dataset.
        pictures: cameras, size, depth and image format.
        include_failed: also convert episodes without success.
        pack: name or folder of the object pack, instead of the recorded one.
        overwrite: replace what is in ``out``.
        append: add to the dataset in ``out``. Its episodes keep their numbers and their side of the split, and
            recordings that it has are not added again. RoboCAS folders only.
        leave_out: warn of episodes that can't be written instead of raising an error.
        embeddings: embed the texts. RoboCAS folders only.
        previews: write a video of each new episode and a contact sheet; None: if there are at most 20 episodes. RoboCAS
            folders only.
        codec: of the RGB videos. LeRobot only.
        lerobot_version: of the LeRobot that will read the dataset, see `lerobot.variants.VARIANTS`. LeRobot only.
        jobs: number of worker processes.
        limits: time and memory per episode; with limits, one job is a separate process too if it renders. An episode
            that exceeds them, or kills its process, is retried once, then skipped. None: no limits.
        open_renderer: opens what renders a trajectory; importable by workers.
    """

    source: Path
    out: Path
    rate_hz: float | None = None
    pictures: Pictures = field(default_factory=Pictures)
    include_failed: bool = False
    pack: str | Path | None = None
    overwrite: bool = False
    append: bool = False
    leave_out: bool = False
    embeddings: bool = True
    previews: bool | None = False
    codec: Codec = "h264"
    lerobot_version: str = NEWEST
    jobs: int = 1
    limits: Limits | None = None
    open_renderer: OpenRenderer = open_env

    @property
    def is_trajectory(self) -> bool:
        """Whether the images of the source have to be rendered."""
        found = format_of(self.source)
        return found.name == "trajectory" if found else not self.source.is_dir()

    @property
    def needs_device(self) -> bool:
        """Whether a render device is needed."""
        return self.open_renderer is open_env and self.is_trajectory

    def check_device(self) -> None:
        """Check that there is a render device, if one is needed.

        Raises:
            DatasetError: there is none.
        """
        if self.needs_device:
            from robocas_ms3.datasets.writing.render import require_renderer

            require_renderer()


@dataclass
class Timing:
    """Seconds that one or several episodes took.

    Attributes:
        load: reading the recording and building its scene; of a dataset, reading its images.
        render: rendering states.
        encode: encoding images (on other threads, during rendering) or videos.
        wait: how long rendering waited for images to be encoded.
        write: arrays, JSON, renaming; joining videos and tables.
        total: wall-clock time.
    """

    load: float = 0.0
    render: float = 0.0
    encode: float = 0.0
    wait: float = 0.0
    write: float = 0.0
    total: float = 0.0

    def __add__(self, other: Timing) -> Timing:
        more = asdict(other)
        return Timing(**{part: seconds + more[part] for part, seconds in asdict(self).items()})

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Add the time spent inside to a field."""
        start = time.perf_counter()
        try:
            yield
        finally:
            setattr(self, part, getattr(self, part) + time.perf_counter() - start)

    def each(self, part: str, items: Iterator[_Item]) -> Iterator[_Item]:
        """Yield items, and add the time that each takes to a field."""
        missing = object()
        while True:
            with self.measure(part):
                item = next(items, missing)
            if item is missing:
                return
            yield cast(_Item, item)


@dataclass(frozen=True)
class WrittenEpisode:
    """An episode on disk.

    Attributes:
        number: in the dataset.
        steps: T.
        size: bytes.
        timing: time that it took.
        row: its row of the contact sheet, (H, W, 3) RGB, if one was wanted.
    """

    number: int
    steps: int
    size: int
    timing: Timing
    row: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Conversion:
    """Result of a conversion.

    Attributes:
        episodes: the new ones, by number.
        kept: number of episodes of the source that were there already.
        seconds: wall-clock time.
        joining: seconds of these for the steps after the last episode.
        previews: whether previews were made.
    """

    episodes: list[WrittenEpisode]
    kept: int
    seconds: float
    joining: float = 0.0
    previews: bool = False

    @property
    def timing(self) -> Timing:
        """Sum over the new episodes in all processes; ``write`` includes the joining."""
        return sum((episode.timing for episode in self.episodes), start=Timing(write=self.joining))
