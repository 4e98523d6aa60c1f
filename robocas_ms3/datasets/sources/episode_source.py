"""Interface of episode sources: trajectory files, RoboCAS folders, LeRobot datasets and other formats.

A source reads an overview when it is opened, and all other data on demand. It keeps no file open, so it can be pickled
and forked.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.datasets.actions import compute_action_space
from robocas_ms3.datasets.images.image_files import Box, ImageOptions
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.recordings.subgoals import SubGoal, group_subgoals
from robocas_ms3.robots.camera_models import CameraModel, find_parent_in_base
from robocas_ms3.robots.cameras import Parent, standard_camera_parent

Split = Literal["train", "val", "all"]
"""Name of a split: training or validation episodes, or all."""
ImageKind = Literal["rgb", "depth"]
"""Kind of image."""
NOTHING, BASKET, ROBOT, FIRST_SLOT = range(4)
"""Values of a segmentation image: other surfaces, the basket, the robot, and the object in the first slot."""


@dataclass(frozen=True)
class StepImages:
    """Images of one step.

    Attributes:
        rgb: RGB image (H, W, 3) by camera.
        depth: depth image (H, W) in mm by camera, 0 = no depth; empty without depth.
        boxes: bounding box of the target by camera that sees it; empty unless requested.
        segmentation: segmentation image (H, W) by camera: `NOTHING`, `BASKET`, `ROBOT`, or `FIRST_SLOT` + slot of an
            object; empty unless requested.
    """

    rgb: dict[str, NDArray[np.uint8]]
    depth: dict[str, NDArray[np.uint16]]
    boxes: dict[str, Box] = field(default_factory=dict)
    segmentation: dict[str, NDArray[np.uint8]] = field(default_factory=dict)


class SourceEpisode(ABC):
    """Episode of an `EpisodeSource`; reading missing or damaged data raises ``DatasetError``.

    Attributes:
        where: path or name of the episode in error messages.
        cameras: names of the cameras with images.
    """

    where: Any
    cameras: tuple[str, ...]

    @property
    def steps(self) -> int:
        """Number of steps, T."""
        return int(self.arrays["episode_length"])

    @property
    def instruction(self) -> str:
        """Language instruction of the episode."""
        return str(self.read(["language_goal"])["language_goal"])

    @property
    @abstractmethod
    def arrays(self) -> dict[str, NDArray]:
        """Arrays of ``episode_info.npz`` that the source has, by key; see `schema.EPISODE_INFO`."""

    def read(self, keys: Sequence[str]) -> dict[str, NDArray]:
        """Return the arrays with these keys; raise DatasetError if one is missing."""
        arrays = self.arrays
        missing = [key for key in keys if key not in arrays]
        if missing:
            raise DatasetError("arrays are missing", where=self.where, expected=", ".join(missing))
        return {key: arrays[key] for key in keys}

    @property
    def goals(self) -> list[SubGoal]:
        """Sub-goals of the episode and their steps; empty if unknown."""
        arrays = self.read(("step_goal_type", "step_lang_goals"))
        return group_subgoals(arrays["step_goal_type"].tolist(), arrays["step_lang_goals"].tolist())

    @property
    def scene(self) -> dict[str, Any]:
        """Content of ``scene.json``: the known keys of `file_models.SceneRecord`; empty if unknown."""
        return {}

    @property
    def layout(self) -> dict[str, Any]:
        """Object layout at the start of the episode, as in `file_models.LayoutRecord`; empty if unknown."""
        return self.scene.get("layout") or {}

    @property
    def target_boxes(self) -> Sequence[dict[str, Box]]:
        """Bounding box of the target for each step, by camera that sees it; empty if unknown."""
        return []

    def rgb(self, camera: str, step: int) -> NDArray[np.uint8]:
        """Return the RGB image (H, W, 3) of a camera at a step."""
        raise _make_no_images_error(self)

    def depth(self, camera: str, step: int) -> NDArray[np.uint16]:
        """Return the depth image (H, W) of a camera at a step, mm, 0 = no depth."""
        raise _make_no_images_error(self)

    def frames(
        self, camera: str, kind: ImageKind = "rgb", first: int = 0, count: int | None = None
    ) -> Generator[NDArray, None, None]:
        """Yield ``count`` images of a camera from step ``first`` on; default: up to the last step.

        Close the generator if you stop before the last image. Formats with videos override this method to decode each
        frame once.
        """
        image = self.rgb if kind == "rgb" else self.depth
        for step in range(first, self.steps if count is None else first + count):
            yield image(camera, step)

    def images(self, image_options: ImageOptions) -> Generator[StepImages, None, None]:
        """Yield the requested images of each step; close the generator if you stop before the last step."""
        boxes = self.target_boxes if image_options.boxes else []
        with closing(iter_images(self, image_options.cameras, "rgb")) as rgb, ExitStack() as stack:
            depth = (
                stack.enter_context(closing(iter_images(self, image_options.cameras, "depth")))
                if image_options.depth
                else None
            )
            for step, images in enumerate(rgb):
                yield StepImages(images, next(depth) if depth else {}, boxes[step] if boxes else {})

    def intrinsic(self, camera: str) -> NDArray[np.float64]:
        """Return the intrinsics of a camera, (4,) fx, fy, cx, cy in pixels."""
        raise _make_no_images_error(self)

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """Return the nominal pose (4, 4) of the OpenCV camera frame in its parent frame, as configured."""
        raise _make_no_images_error(self)

    def true_camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """Return the pose (4, 4) of the camera with its random motion; default: the nominal pose."""
        return self.camera_in_parent(camera)

    def camera_in_base(self, camera: str) -> NDArray[np.float64]:
        """Return the nominal poses (T, 4, 4) of the OpenCV camera frame in the arm's base frame."""
        arrays = self.read(("ee_pos", "ee_orn", "base_pos", "base_orn"))
        ee, base = (
            from_xyzw(arrays[f"{name}_pos"].astype(np.float64), arrays[f"{name}_orn"].astype(np.float64))
            for name in ("ee", "base")
        )
        model = self.camera(camera)
        return find_parent_in_base(model.parent, ee, base) @ model.camera_in_parent

    def camera_parent(self, camera: str) -> Parent:
        """Return the parent frame of the camera pose; default: as for the standard camera with this name."""
        return standard_camera_parent(camera)

    def camera(self, name: str) -> CameraModel:
        """Return the intrinsics and the poses of a camera."""
        return CameraModel(
            self.intrinsic(name),
            self.camera_in_parent(name),
            self.camera_parent(name),
            self.true_camera_in_parent(name),
        )


def _make_no_images_error(episode: SourceEpisode) -> DatasetError:
    fix = "Render them with robocas convert."
    return DatasetError("this episode has no images", where=episode.where, fix=fix)


def iter_images(
    episode: SourceEpisode, cameras: Sequence[str], kind: ImageKind = "rgb"
) -> Generator[dict[str, NDArray], None, None]:
    """Yield the images of each step, by camera; close the generator if you stop before the last step."""
    steps = episode.steps
    with ExitStack() as stack:
        runs = {camera: stack.enter_context(closing(episode.frames(camera, kind, 0, steps))) for camera in cameras}
        for _ in range(steps):
            yield {camera: next(run) for camera, run in runs.items()}


class EpisodeSource(ABC):
    """Trajectory file or dataset of any format, which is read episode by episode.

    Reading missing or damaged data raises ``DatasetError``.

    Attributes:
        root: path of the folder or file.
        rate_hz: steps per second.
        numbers: sorted episode numbers.
        cameras: names of the cameras with images.
        has_depth: whether there are depth images.
        has_embeddings: whether there are embeddings of the texts.
    """

    root: Path
    rate_hz: float
    numbers: list[int]
    cameras: tuple[str, ...]
    has_depth: bool
    has_embeddings: bool = False

    @cached_property
    def lengths(self) -> Mapping[int, int]:
        """Number of steps T by episode number."""
        return {number: self.episode(number).steps for number in self.numbers}

    def split(self, name: Split) -> list[int]:
        """Return the episode numbers of a split.

        The default splits by the seed of the episode, or by its number if the seed is unknown.
        """
        if name == "all":
            return self.numbers
        seeds = {number: self.conversion_entry(number).get("seed") for number in self.numbers}
        return split_by_seed(seeds)[name == "val"]

    def conversion_entry(self, number: int) -> Mapping[str, Any]:
        """Return the entry of an episode in ``conversion.json``, such as its seed; empty if unknown.

        `provenance.make_recording_entry` lists the keys.
        """
        return {}

    def action_space(self) -> dict[str, Any]:
        """Return ``action_space`` as in ``data_info.json``; the default computes it from all episodes."""
        episodes = [self.episode(number).read(("rel_pos", "rel_orn")) for number in self.numbers]
        return compute_action_space(
            [arrays["rel_pos"] for arrays in episodes], [arrays["rel_orn"] for arrays in episodes]
        )

    @abstractmethod
    def episode(self, number: int) -> SourceEpisode:
        """Return an episode by number; its data are read on access."""

    def close(self) -> None:  # noqa: B027  (most sources keep nothing open)
        """Close renderers or files that the source keeps open."""
