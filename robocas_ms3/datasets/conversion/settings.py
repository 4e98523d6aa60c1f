"""Settings of a conversion, which are the options of ``robocas convert``, and its result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot.variants import NEWEST, Version
from robocas_ms3.demos.settings import find_trajectory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from robocas_ms3.core.workers import Limits
    from robocas_ms3.datasets.images.image_files import ImageOptions

_NO_HINT = tyro.conf.arg(help_behavior_hint="")  # the help text states the default


@dataclass(frozen=True)
class ConversionOptions:
    """Input, output and episodes."""

    source: Annotated[Path, tyro.conf.Positional]
    """Output folder of robocas generate, or its trajectory file F.h5 (with F.json next to it).
    With --to lerobot also the folder of a dataset with images."""
    out: Path
    """Output folder of the dataset."""
    include_failed: bool = False
    """Convert failed episodes too."""
    overwrite: bool = False
    """Start again. Default: continue an interrupted conversion with the same settings."""
    append: bool = False
    """Add episodes to an existing dataset. The existing episodes keep their numbers and their split."""
    skip_errors: bool = False
    """Skip episodes that can't be written, with a warning. Default: write the other episodes, then report an error."""
    pack: Annotated[str | None, tyro.conf.arg(metavar="PACK"), _NO_HINT] = None
    """Name or folder of the object pack to use instead of the recorded one."""
    open_renderer: Annotated[Any, tyro.conf.Suppress, tyro.conf.Fixed] = None
    """Function that opens a renderer, see `rendered_source.OpenRenderer`. Default: `env_renderer.EnvRenderer`."""


@dataclass(frozen=True, kw_only=True)
class FormatOptions:
    """Format and content of the dataset."""

    to: Annotated[str, tyro.conf.arg(metavar="FORMAT")] = "robocas"
    """Output format: robocas, lerobot (needs the extra 'lerobot'), or a format of another package."""
    lerobot_version: Version = NEWEST
    """LeRobot version that will read the dataset.
    0.6: LeRobot 0.6 and later (format v3.0 with language columns and depth videos);
    0.5: LeRobot 0.4.4 to 0.5.1 (format v3.0 with subtask_index);
    2.1: openpi, GR00T and other readers of format v2.1."""
    codec: Literal["h264", "av1"] = "h264"
    """Video codec of a LeRobot dataset; av1 needs half the disk space of h264."""
    rate_hz: Annotated[float | None, tyro.conf.arg(name="rate", help_behavior_hint="")] = None
    """Rate of the dataset in Hz; must divide the control frequency. Default: 5, or the rate of the input dataset."""
    embeddings: bool = True
    """Store embeddings of the instruction and the sub-goals (needs the extra 'language'; not for lerobot)."""
    video: bool = True
    """Write a video per episode and a contact sheet to OUT/preview, if there are at most 20 episodes.
    Not for lerobot."""
    all_videos: bool = False
    """Write videos and a contact sheet for more than 20 episodes too."""


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Images of the dataset."""

    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CAMERA [CAMERA ...]"), _NO_HINT] = ()
    """Names of the cameras. Default: all cameras of the input; with --append those of the output dataset."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="W H"), _NO_HINT] = None
    """Image width and height in pixels.
    Default: the size in the task configuration (640 480); with --append the size of the dataset."""
    depth: bool = True
    """Store depth images in addition to RGB."""
    image_format: Literal["png", "jpg", "webp"] = "png"
    """Format of RGB images (not for lerobot); the RoboCAS-v0 loader reads png only."""
    boxes: Annotated[bool, tyro.conf.Suppress] = False
    """Compute the bounding box of the target in each image."""


@dataclass(frozen=True, kw_only=True)
class ProcessOptions:
    """Processes and limits; the dataset does not depend on them."""

    jobs: int = 1
    """Number of processes that render."""
    episode_seconds: float = 3600.0
    """Time limit per episode in seconds.
    An episode that exceeds the time or memory limit, or crashes its process, is retried once.
    If it fails again, it can't be written; see --skip-errors."""
    memory_gb: float = 8.0
    """Memory limit per process in GiB."""


@dataclass(frozen=True)
class ConversionSettings(ConversionOptions, FormatOptions, RenderOptions, ProcessOptions):
    """Convert a trajectory file to a dataset, or a RoboCAS dataset to a LeRobot dataset.

    Example: robocas convert demos/pick/trajectory.h5 --out datasets/pick --jobs 2
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", find_trajectory(self.source))
        for first, second, both in (
            ("--overwrite", "--append", self.overwrite and self.append),
            ("--no-video", "--all-videos", self.all_videos and not self.video),
        ):
            if both:
                raise DatasetError(f"can't be combined with {second}", where=first, fix="Pass one of them.")
        if self.jobs < 1:
            what, expected = "invalid number of processes", "1 or more"
            raise DatasetError(what, where="--jobs", expected=expected, found=self.jobs)
        if not self.episode_seconds >= 1:
            expected = "1 or more seconds"
            raise DatasetError(
                "invalid time limit", where="--episode-seconds", expected=expected, found=self.episode_seconds
            )
        if not self.memory_gb > 0:
            raise DatasetError("invalid memory limit", where="--memory-gb", expected="> 0 GiB", found=self.memory_gb)
        if len(set(self.cameras)) < len(self.cameras):
            found = " ".join(self.cameras)
            raise DatasetError("repeated camera", where="--cameras", expected="each name once", found=found)
        if self.size is not None:
            from robocas_ms3.datasets.images.image_files import check_image_size

            check_image_size(self.size, "--size")

    @property
    def image_options(self) -> ImageOptions:
        from robocas_ms3.datasets.images.image_files import ImageOptions

        return ImageOptions(self.cameras, self.size, self.depth, self.image_format, self.boxes)

    @property
    def limits(self) -> Limits | None:
        """Limits of time and memory per episode, None without limits.

        With limits, a single renderer runs in a separate process too.
        """
        from robocas_ms3.core.workers import Limits

        if math.isinf(self.episode_seconds) and math.isinf(self.memory_gb):
            return None
        return Limits(self.episode_seconds, self.memory_gb)

    @property
    def is_trajectory(self) -> bool:
        from robocas_ms3.datasets.formats import detect_format

        found = detect_format(self.source)
        return found.name == "trajectory" if found else not self.source.is_dir()

    @property
    def needs_renderer(self) -> bool:
        return self.open_renderer is None and self.is_trajectory

    def require_renderer(self) -> None:
        if self.needs_renderer:
            from robocas_ms3.datasets.conversion.env_renderer import require_renderer

            require_renderer()


@dataclass(frozen=True)
class WrittenEpisode:
    """Episode that a conversion has written.

    Attributes:
        number: number of the episode in the dataset.
        steps: number of steps T.
        size: size on disk, bytes.
        row: row of the contact sheet with this episode, (H, W, 3) RGB; None: it has none.
    """

    number: int
    steps: int
    size: int
    row: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class ConversionResult:
    """Result of a conversion.

    Attributes:
        episodes: episodes that this conversion has written.
        existing: number of episodes that existed already.
        seconds: wall-clock time, s.
        previews: whether videos and a contact sheet were written.
    """

    episodes: list[WrittenEpisode]
    existing: int
    seconds: float
    previews: bool = False
