"""Pictures of training samples: decoded, scaled, and stacked."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import get_worker_info

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.sources.protocol import Kind, SourceEpisode

_settled = -1  # the process that was settled last


@dataclass(frozen=True)
class PictureStack:
    """How pictures are given.

    Attributes:
        cameras: names, in the order of the stack.
        size: width and height to scale to; None: as they are.
        float_images: RGB as float32 in 0..1 instead of uint8.
    """

    cameras: tuple[str, ...]
    size: tuple[int, int] | None
    float_images: bool

    def read(self, episode: SourceEpisode, observed: NDArray[np.int64], kind: Kind, *, zero: bool) -> torch.Tensor:
        """Read the pictures of some steps: (H, C, 3, h, w) or (H, C, h, w).

        Args:
            episode: they are in.
            observed: (H,) steps, one after the other; below 0 before the episode.
            kind: of picture.
            zero: whether what is before the episode is zeros; else it is the first picture.

        Raises:
            DatasetError: a file is missing or damaged, or sizes differ.
        """
        _settle_process()
        steps = np.maximum(observed, 0)
        first, count = int(steps[0]), int(steps[-1] - steps[0]) + 1
        runs = [self._run(episode, camera, kind, first, count) for camera in self.cameras]
        decoded = [self._stack(episode, shots) for shots in zip(*runs, strict=True)]
        shapes = {picture.shape for picture in decoded}
        if len(shapes) > 1:
            raise DatasetError("pictures differ in size", where=episode.where, found=sorted(shapes), fix="Pass a size.")
        stack = np.stack([decoded[step - first] for step in steps])
        if zero:
            stack[observed < 0] = 0
        return torch.from_numpy(stack)

    def _run(self, episode: SourceEpisode, camera: str, kind: Kind, first: int, count: int) -> list[NDArray]:
        shots = []
        with closing(episode.frames(camera, kind, first, count)) as pictures:
            for step, picture in enumerate(pictures, start=first):
                if (picture.ndim, picture.dtype) != ((3, np.uint8) if kind == "rgb" else (2, np.uint16)):
                    raise DatasetError(
                        "not a picture of this kind",
                        where=f"{episode.where}/{camera}/{kind}, step {step}",
                        expected="(H, W, 3) uint8" if kind == "rgb" else "(H, W) uint16",
                        found=f"{picture.shape} {picture.dtype}",
                    )
                shots.append(resize(picture, self.size))
        return shots

    def _stack(self, episode: SourceEpisode, shots: Sequence[NDArray]) -> NDArray:
        """One step's pictures, cameras first: (C, 3, h, w) or (C, h, w)."""
        if len({shot.shape for shot in shots}) > 1:
            found = [shot.shape for shot in shots]
            raise DatasetError("cameras differ in size", where=episode.where, found=found, fix="Pass a size.")
        stack = np.stack(shots)
        if stack.ndim == 3:
            return stack.astype(np.float32) / 1000
        stack = np.ascontiguousarray(stack.transpose(0, 3, 1, 2))
        return stack.astype(np.float32) / 255 if self.float_images else stack


def _settle_process() -> None:
    """In a worker: one thread for OpenCV, whose pool does not survive a fork."""
    global _settled  # noqa: PLW0603  (state of a process)
    if _settled != os.getpid():
        _settled = os.getpid()
        if get_worker_info() is not None:
            cv2.setNumThreads(0)


def resize(picture: NDArray, size: tuple[int, int] | None) -> NDArray:
    """Scale to width and height: RGB by areas, depth by the nearest pixel, which mixes no distances."""
    if size is None or picture.shape[1::-1] == tuple(size):
        return picture
    smaller = size[0] <= picture.shape[1] and size[1] <= picture.shape[0]
    if picture.ndim == 2:
        return cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
