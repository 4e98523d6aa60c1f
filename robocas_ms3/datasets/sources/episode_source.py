"""Episodes to read, whatever they lie in: a trajectory file, a RoboCAS folder, a LeRobot folder, or another's format.

A source reads an overview when it is opened and everything else when it is asked for; it keeps no file open, so it may
be pickled and forked.
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
from robocas_ms3.datasets.actions import action_space
from robocas_ms3.datasets.images.image_files import Box, ImageOptions
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.recordings.subgoals import SubGoal, subgoal_runs
from robocas_ms3.robots.cameras import Parent, standard_camera_parent

Split = Literal["train", "val", "all"]
"""Of the split into training and validation."""
ImageKind = Literal["rgb", "depth"]
"""Of image."""


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics (4,) fx, fy, cx, cy in pixels, and pose (4, 4) of the OpenCV camera frame in its parent frame."""

    intrinsic: NDArray[np.float64]
    camera_in_parent: NDArray[np.float64]
    parent: Parent


@dataclass(frozen=True)
class StepImages:
    """The images of one step: camera -> (H, W, 3) uint8, (H, W) uint16 in mm, box of the target's visible pixels."""

    rgb: dict[str, NDArray[np.uint8]]
    depth: dict[str, NDArray[np.uint16]]
    boxes: dict[str, Box] = field(default_factory=dict)


class SourceEpisode(ABC):
    """An episode; what is read raises ``DatasetError`` where it is missing or damaged.

    Attributes:
        where: path or name, for messages.
        cameras: names of those with images.
    """

    where: Any
    cameras: tuple[str, ...]

    @property
    def steps(self) -> int:
        """Number of steps, T."""
        return int(self.arrays["episode_length"])

    @property
    def instruction(self) -> str:
        """Text that the robot is told."""
        return str(self.read(["language_goal"])["language_goal"])

    @property
    @abstractmethod
    def arrays(self) -> dict[str, NDArray]:
        """Arrays of ``schema.EPISODE_INFO`` that are there."""

    def read(self, keys: Sequence[str]) -> dict[str, NDArray]:
        """Return some of the arrays, which have to be there."""
        arrays = self.arrays
        missing = [key for key in keys if key not in arrays]
        if missing:
            raise DatasetError("arrays are missing", where=self.where, expected=", ".join(missing))
        return {key: arrays[key] for key in keys}

    @property
    def goals(self) -> list[SubGoal]:
        """Sub-goals over the steps; empty where they are not known."""
        arrays = self.read(("step_goal_type", "step_lang_goals"))
        return subgoal_runs(arrays["step_goal_type"].tolist(), arrays["step_lang_goals"].tolist())

    @property
    def scene(self) -> dict[str, Any]:
        """How it was made, by the keys of `records.SceneRecord` that are known; empty where none is."""
        return {}

    @property
    def layout(self) -> dict[str, Any]:
        """What stood where at its beginning, as ``layout`` of `records.SceneRecord`; empty where it is not known."""
        return self.scene.get("layout") or {}

    @property
    def target_boxes(self) -> Sequence[dict[str, Box]]:
        """Box of the target in each step, by the cameras that see it; empty where they are not known."""
        return []

    def rgb(self, camera: str, step: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        raise _no_images(self)

    def depth(self, camera: str, step: int) -> NDArray[np.uint16]:
        """(H, W) mm, 0 = nothing."""
        raise _no_images(self)

    def frames(
        self, camera: str, kind: ImageKind = "rgb", first: int = 0, count: int | None = None
    ) -> Generator[NDArray, None, None]:
        """Yield the images of ``count`` steps; close the generator unless it is read to the end.

        Here they are read one by one; a format that is quicker in a run, as a video is, overrides this.
        """
        image = self.rgb if kind == "rgb" else self.depth
        for step in range(first, self.steps if count is None else first + count):
            yield image(camera, step)

    def images(self, image_options: ImageOptions) -> Generator[StepImages, None, None]:
        """Yield the images of every step; close the generator unless it is read to the end."""
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
        """(4,) fx, fy, cx, cy in pixels."""
        raise _no_images(self)

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """(4, 4) OpenCV camera frame in its parent."""
        raise _no_images(self)

    def camera_parent(self, camera: str) -> Parent:
        """Return the frame that the pose of a camera is in; here by the names of the standard cameras."""
        return standard_camera_parent(camera)

    def camera(self, name: str) -> CameraModel:
        return CameraModel(self.intrinsic(name), self.camera_in_parent(name), self.camera_parent(name))


def _no_images(episode: SourceEpisode) -> DatasetError:
    fix = "Convert it with robocas convert."
    return DatasetError("this episode has no images", where=episode.where, fix=fix)


def iter_images(
    episode: SourceEpisode, cameras: Sequence[str], kind: ImageKind = "rgb"
) -> Generator[dict[str, NDArray], None, None]:
    """Yield the images of every step, by camera; close the generator unless it is read to the end."""
    steps = episode.steps
    with ExitStack() as stack:
        runs = {camera: stack.enter_context(closing(episode.frames(camera, kind, 0, steps))) for camera in cameras}
        for _ in range(steps):
            yield {camera: next(run) for camera, run in runs.items()}


class EpisodeSource(ABC):
    """Episodes by number; what is read raises ``DatasetError`` where it is missing or damaged.

    Attributes:
        root: the folder or file.
        rate_hz: steps per second.
        numbers: of its episodes, sorted.
        cameras: names of those with images.
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
        """Number -> T."""
        return {number: self.episode(number).steps for number in self.numbers}

    def split(self, side: Split) -> list[int]:
        """Return the numbers of the episodes of one side; here by seed, or by number where there is none."""
        if side == "all":
            return self.numbers
        return split_by_seed({number: self.entry(number).get("seed") for number in self.numbers})[side == "val"]

    def entry(self, number: int) -> Mapping[str, Any]:
        """Return the recording of an episode, see ``provenance.recording_entry``; empty where it is not known."""
        return {}

    def action_space(self) -> dict[str, Any]:
        """Return the range of the motion, as in ``data_info.json``; here all episodes are read for it."""
        parts = [self.episode(number).read(("rel_pos", "rel_orn")) for number in self.numbers]
        return action_space([part["rel_pos"] for part in parts], [part["rel_orn"] for part in parts])

    @abstractmethod
    def episode(self, number: int) -> SourceEpisode:
        """Open an episode."""

    def close(self) -> None:  # noqa: B027  (most sources keep nothing open)
        """Free what is open."""
