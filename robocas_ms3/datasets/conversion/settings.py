"""Settings of a conversion, which are the options of `robocas convert`, and its result. Loads no simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot.variants import NEWEST, Version

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from robocas_ms3.core.workers import Limits
    from robocas_ms3.datasets.images.image_files import ImageOptions

_NO_HINT = tyro.conf.arg(help_behavior_hint="")  # the help text says what the default is


@dataclass(frozen=True)
class ConversionSettings:
    """Render a trajectory file of `robocas generate` into a dataset, or turn a RoboCAS dataset into a LeRobot dataset.

    Example: robocas convert demos/pick/trajectory.h5 --out datasets/pick --jobs 2
    """

    source: Annotated[Path, tyro.conf.Positional]
    """F.h5, with F.json next to it. With --to lerobot also the folder of a RoboCAS dataset, whose images are used."""
    out: Path
    """Folder of the dataset."""
    to: str = "robocas"
    """Format of the dataset: robocas, lerobot (needs the extra 'lerobot'), or one of another package."""
    lerobot_version: Version = NEWEST
    """Reader of the LeRobot dataset. 0.6: LeRobot 0.6 and later (format v3.0, language columns, depth as video);
    0.5: LeRobot 0.4.4 to 0.5.1 (v3.0, subtask_index); 2.1: readers of format v2.1, such as openpi and GR00T."""
    codec: Literal["h264", "av1"] = "h264"
    """Codec of the videos of a LeRobot dataset; AV1 takes half the space."""
    rate_hz: Annotated[float | None, tyro.conf.arg(name="rate", help_behavior_hint="")] = None
    """Steps per second; must divide the control frequency. Default: 5, or the rate of the RoboCAS dataset."""
    embeddings: bool = True
    """Embed instruction and sub-goals (needs the extra 'language'; not for lerobot)."""
    video: bool = True
    """Write a video of each episode and a contact sheet into OUT/preview, if there are at most 20 episodes (not for
    lerobot)."""
    all_videos: bool = False
    """Write videos and contact sheet of more than 20 episodes too."""
    cameras: Annotated[tuple[str, ...], _NO_HINT] = ()
    """Cameras to render, or to take from the dataset. Default: all that there are."""
    size: Annotated[tuple[int, int] | None, _NO_HINT] = None
    """Width and height of the images. Default: those of the cameras, 640 480."""
    depth: bool = True
    """Store depth in addition to RGB."""
    image_format: Literal["png", "jpg", "webp"] = "png"
    """Format of RGB images; the loader released with RoboCAS opens png only. Not for lerobot, which stores videos."""
    include_failed: bool = False
    """Also convert episodes without success."""
    overwrite: bool = False
    """Start again. Default: continue a conversion with the same settings that was interrupted."""
    append: bool = False
    """Add to the dataset that is there; its episodes keep their numbers and their side of the split."""
    skip_errors: bool = False
    """Warn of episodes that can't be written, in place of an error in the end; LeRobot datasets are joined without."""
    jobs: int = 1
    """Processes that render."""
    episode_seconds: float = 3600.0
    """Seconds that an episode may take. An episode that takes longer, needs more memory or crashes its process is
    retried once, then skipped and named at the end, like one that can't be rendered or stored."""
    memory_gb: float = 8.0
    """GB of memory that a process may use."""
    pack: Annotated[str | None, _NO_HINT] = None
    """Object pack to use instead of the recorded one: its name, or its folder."""
    boxes: Annotated[bool, tyro.conf.Suppress] = False
    """Determine the box of the target in each image."""
    open_renderer: Annotated[Any, tyro.conf.Suppress, tyro.conf.Fixed] = None
    """Opens what renders, see `rendered_source.OpenRenderer`; importable by workers. None: the recorded environment."""

    def __post_init__(self) -> None:
        excluding = "--overwrite --append" if self.overwrite and self.append else ""
        excluding = "--no-video --all-videos" if self.all_videos and not self.video else excluding
        if excluding:
            raise DatasetError("these exclude each other", where="convert", expected="one of them", found=excluding)
        if self.jobs < 1:
            raise DatasetError("not a number of processes", where="--jobs", expected="1 or more", found=self.jobs)
        if not (self.episode_seconds >= 1 and self.memory_gb > 0):
            found = f"--episode-seconds {self.episode_seconds:g} --memory-gb {self.memory_gb:g}"
            raise DatasetError("no episode can be written within that", where="convert", found=found)
        if len(set(self.cameras)) < len(self.cameras):
            found = " ".join(self.cameras)
            raise DatasetError("a camera is named twice", where="--cameras", expected="each once", found=found)

    @property
    def image_options(self) -> ImageOptions:
        from robocas_ms3.datasets.images.image_files import ImageOptions

        return ImageOptions(self.cameras, self.size, self.depth, self.image_format, self.boxes)

    @property
    def limits(self) -> Limits | None:
        """Time and memory per episode. With limits, one job is a separate process too if it renders."""
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
    def needs_device(self) -> bool:
        return self.open_renderer is None and self.is_trajectory

    def check_device(self) -> None:
        if self.needs_device:
            from robocas_ms3.datasets.conversion.env_renderer import require_renderer

            require_renderer()


@dataclass(frozen=True)
class WrittenEpisode:
    """An episode on disk: T, bytes, and its row of the contact sheet, (H, W, 3) RGB, if one was wanted."""

    number: int
    steps: int
    size: int
    row: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Conversion:
    """Result of a conversion: new episodes by number, number of those that were there, wall-clock time."""

    episodes: list[WrittenEpisode]
    existing: int
    seconds: float
    previews: bool = False
