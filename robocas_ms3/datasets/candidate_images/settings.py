"""Settings of the rendering of decisions, which are the options of ``robocas render-candidates``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from robocas_ms3.core.errors import DatasetError

if TYPE_CHECKING:
    from robocas_ms3.datasets.images.image_files import ImageOptions

MAX_VIEWS = 32
_NO_HINT = tyro.conf.arg(help_behavior_hint="")  # the help text states the default


@dataclass(frozen=True)
class CandidateImageSettings:
    """Render the camera images of the decisions in a candidates.h5.

    Example: robocas render-candidates demos/search/candidates.h5 --size 320 240 --jobs 2
    """

    candidates: Annotated[Path, tyro.conf.Positional]
    """File candidates.h5 of robocas generate --record-candidates, or its folder."""
    out: Annotated[Path | None, _NO_HINT] = None
    """Output file. Default: candidates_images.h5 next to candidates.h5."""
    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CAMERA [CAMERA ...]"), _NO_HINT] = ()
    """Names of the cameras. Default: all cameras of the task."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="W H"), _NO_HINT] = None
    """Image width and height in pixels. Default: the size in the task configuration (640 480)."""
    depth: bool = True
    """Store depth images in addition to RGB."""
    segmentation: bool = False
    """Store segmentation images in addition to RGB."""
    views: int = 0
    """Number of further views of each decision by the gripper camera, which the arm moves above an object.
    They are stored as cameras view_1_camera, view_2_camera, ..."""
    pack: Annotated[str | None, tyro.conf.arg(metavar="PACK"), _NO_HINT] = None
    """Name or folder of the object pack to use instead of the recorded one."""
    jobs: int = 1
    """Number of processes that render."""
    overwrite: bool = False
    """Delete the images and start again. Default: continue an interrupted rendering with the same settings."""
    open_renderer: Annotated[Any, tyro.conf.Suppress, tyro.conf.Fixed] = None
    """Function that opens a renderer, see `rendered_source.OpenRenderer`. Default: `env_renderer.EnvRenderer`."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            what, expected = "invalid number of processes", "1 or more"
            raise DatasetError(what, where="--jobs", expected=expected, found=self.jobs)
        if not 0 <= self.views <= MAX_VIEWS:
            expected = f"0 to {MAX_VIEWS}"
            raise DatasetError("invalid number of views", where="--views", expected=expected, found=self.views)
        if self.size is not None:
            from robocas_ms3.datasets.images.image_files import check_image_size

            check_image_size(self.size, "--size")

    @property
    def output(self) -> Path:
        """Path of the output file."""
        from robocas_ms3.datasets.candidate_images.images_file import images_path

        return self.out or images_path(self.candidates)

    @property
    def image_options(self) -> ImageOptions:
        from robocas_ms3.datasets.images.image_files import ImageOptions

        return ImageOptions(self.cameras, self.size, self.depth, segmentation=self.segmentation)


@dataclass(frozen=True)
class CandidateImageResult:
    """Result of a rendering.

    Attributes:
        decisions: number of decisions with images.
        rendered: number of decisions that this call rendered.
        size: size of the file, bytes.
        seconds: wall-clock time, s.
    """

    decisions: int
    rendered: int
    size: int
    seconds: float
