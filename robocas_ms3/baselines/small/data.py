"""Training samples of `small`: images, which are decoded once and kept in memory, and labels."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Batch, OnRead, Split
from robocas_ms3.baselines.chunks import (
    compute_normalizer_statistics,
    encode_chunks,
    encode_next_key_poses,
    encode_proprioception,
)
from robocas_ms3.baselines.dataset_checks import check_dataset, open_image_dataset
from robocas_ms3.baselines.small.config import CameraView, SmallConfig
from robocas_ms3.baselines.small.localization import project_points_to_view
from robocas_ms3.baselines.small.objects import (
    SceneObjects,
    calibrations_agree,
    locate_objects,
    read_calibration,
    to_camera_parent_frame,
)
from robocas_ms3.baselines.training.scenes import read_training_scenes
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import Array, from_xyzw
from robocas_ms3.datasets.schema import INTENDED_POSE
from robocas_ms3.robots.quantities import GRIPPER_WIDTH

_log = logging.getLogger(__name__)
_MIN_HEIGHT_DEVIATION = 0.01  # m
_MIN_TEXT_DEVIATION = 0.01  # of a component of an embedding; components are about 0.05
_KEYS = ("ee_pos", "ee_orn", GRIPPER_WIDTH, "gripper_status", "base_pos", "base_orn")


class SmallSamples:
    """Training samples of `small`, one per policy step of a split of a dataset."""

    def __init__(self, config: SmallConfig, path: Path, split: Split, on_read: OnRead) -> None:
        self._config, self._source = config, open_image_dataset(path)
        source, views = self._source, config.views
        numbers = check_dataset(source, split, views, config.rate_hz, language=config.language)
        self.episodes, self.scenes = len(numbers), read_training_scenes(source, numbers)
        first = source.episode(numbers[0])
        shapes = {camera: first.rgb(camera, 0).shape for camera in views}
        sizes = {camera: (shape[1], shape[0]) for camera, shape in shapes.items()}
        _check_image_sizes(sizes, views, source.root)
        base = first.read(["base_pos", "base_orn"])
        self._calibration = {
            camera: read_calibration(first, camera, base, sizes[camera], view) for camera, view in views.items()
        }
        lengths = [source.lengths[number] for number in numbers]
        count = sum(lengths)
        _check_memory(config, count, path)
        self._images = {
            camera: torch.empty((count, view.size[1], view.size[0], 3), dtype=torch.uint8)
            for camera, view in views.items()
        }
        self._state = torch.empty((count, 10))
        self._chunks = torch.empty((count, config.chunk, 10))
        self._keys = torch.empty((count, 9))
        self._key_pixels = {camera: torch.empty((count, 2)) for camera in views}
        self._texts = torch.zeros((len(numbers), 384))
        self._episode = torch.from_numpy(np.repeat(np.arange(len(numbers)), lengths))
        starts = (np.cumsum(lengths) - lengths).tolist()
        scenes: list[SceneObjects] = []
        # threads decode images only: NumPy reads arrays with `ast`, which is not thread-safe in Python 3.11 (gh-106905)
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            image_sizes = pool.map(self._read_images, numbers, starts)
            for number, start, sizes in zip(numbers, starts, image_sizes, strict=True):
                scenes.append(self._read_arrays(len(scenes), number, start, sizes))
                on_read(len(scenes), len(numbers))
        self._choose_object_texts(scenes if config.language else [replace(objects, target="") for objects in scenes])
        if config.language and split == "train" and not (self._classes >= 0).any():
            what = "no object poses in scene.json, so the network does not learn to locate the named object"
            _log.warning("%s: %s", path, what)
        self.facts: dict[str, Any] = {
            "rate_hz": source.rate_hz,
            "image_sizes": {camera: list(size) for camera, size in sizes.items()},
            "chunk": compute_normalizer_statistics(self._chunks[..., :9].numpy()),
            "keys": compute_normalizer_statistics(self._keys.numpy()),
            **({"calibration": self._calibration} if config.unproject else {}),
            "heights": _height_statistics(self._state.numpy(), self._keys.numpy()),
            "text": _text_statistics(self._texts.numpy()),
        }

    def __len__(self) -> int:
        return len(self._state)

    def __getitems__(self, indices: list[int]) -> Batch:
        """Return a batch of B samples.

        Inputs:
            CAMERA: (B, h, w, 3) uint8 images of each camera, cropped and scaled to its view.
            state: (B, 10) proprioception, see `encode_proprioception`.
            text: (B, 384) embedding of the instruction.

        Labels, for up to N objects per scene:
            chunk: (B, K, 10) chunk, see `chunks`.
            key: (B, 9) next key pose in the TCP frame.
            CAMERA_key_pixel: (B, 2) pixel of the next key pose in each view.
            CAMERA_object_pixels: (B, N, 2) pixels of the objects in each view; NaN: unknown.
            object_heights: (B, N) heights of the objects in the arm's base frame, m.
            object_texts: (B, N, 384) embeddings of instructions that name the objects.
            object_classes: (B, N) class index of each object; -1: no instruction of the dataset names the object.
        """
        rows = torch.tensor(indices)
        episodes = self._episode[rows]
        return {
            **{camera: images[rows] for camera, images in self._images.items()},
            **{f"{camera}_key_pixel": pixels[rows] for camera, pixels in self._key_pixels.items()},
            **{f"{camera}_object_pixels": pixels[rows] for camera, pixels in self._object_pixels.items()},
            "object_classes": self._classes[episodes],
            "object_heights": self._object_heights[episodes],
            "object_texts": self._texts[self._object_texts[episodes]],
            "state": self._state[rows],
            "text": self._texts[episodes],
            "chunk": self._chunks[rows],
            "key": self._keys[rows],
        }

    def _read_images(self, number: int, start: int) -> dict[str, tuple[int, int]]:
        """Decode the images of an episode into the sample tensors, from row ``start`` on.

        Returns:
            Width and height of the images in the dataset, by camera.
        """
        episode, sizes = self._source.episode(number), {}
        for camera, view in self._config.views.items():
            with closing(episode.frames(camera, "rgb", 0, self._source.lengths[number])) as images:
                for row, image in enumerate(images, start=start):
                    self._images[camera][row] = torch.from_numpy(crop_image(image, view, self._source.root))
                    sizes[camera] = image.shape[1], image.shape[0]
        return sizes

    def _read_arrays(self, index: int, number: int, start: int, sizes: dict[str, tuple[int, int]]) -> SceneObjects:
        """Read the states and labels of an episode into the sample tensors, from row ``start`` on.

        Args:
            index: number of the episode among these samples; ``number`` is its number in the dataset.
            sizes: result of `_read_images`.

        Returns:
            Objects of the episode.
        """
        config, episode = self._config, self._source.episode(number)
        optional = [key for key in INTENDED_POSE if key in episode.arrays]
        arrays = episode.read([*_KEYS, *optional, *(["language_embedding"] if config.language else [])])
        length = self._source.lengths[number]
        for key, array in arrays.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                where = f"{self._source.root}, episode {number}, {key}"
                raise DatasetError("NaN or infinite value", where=where, fix="Run `robocas validate` for details.")
        poses = from_xyzw(arrays["ee_pos"].astype(np.float64), arrays["ee_orn"].astype(np.float64))
        opened, rows = arrays["gripper_status"].reshape(-1), slice(start, start + length)
        self._state[rows] = torch.from_numpy(encode_proprioception(poses, arrays[GRIPPER_WIDTH].reshape(-1)))
        intended = from_xyzw(*(arrays[key].astype(np.float64) for key in INTENDED_POSE)) if optional else None
        self._chunks[rows] = torch.from_numpy(encode_chunks(poses, opened, config.chunk, intended))
        keys = encode_next_key_poses(poses, opened, intended)
        key_points = (poses[:, :3, :3] @ keys[:, :3, None])[..., 0] + poses[:, :3, 3]  # in the arm's base frame
        self._keys[rows] = torch.from_numpy(keys)
        if config.language:
            self._texts[index] = torch.from_numpy(arrays["language_embedding"])
        projections: dict[str, Callable[[Array], NDArray[np.float32]]] = {}
        for camera, view in config.views.items():
            found = read_calibration(episode, camera, arrays, sizes[camera], view)
            self._check_calibration(camera, found, episode.where)
            projections[camera] = partial(
                project_points_to_view,
                camera_in_parent=episode.true_camera_in_parent(camera),
                intrinsic=episode.intrinsic(camera),
                stored_size=sizes[camera],
                view=view,
            )
            points = to_camera_parent_frame(episode.camera_parent(camera), key_points[:, None], poses, arrays)[:, 0]
            self._key_pixels[camera][rows] = torch.from_numpy(projections[camera](points))
        return locate_objects(episode, arrays, poses, projections)

    def _check_calibration(self, camera: str, found: dict[str, Any], where: object) -> None:
        first = self._calibration[camera]
        if self._config.unproject and not calibrations_agree(first, found):
            key = "mount" if not calibrations_agree(first, found, ["mount"]) else "intrinsic"
            raise DatasetError(
                "camera calibration differs between episodes",
                where=f"{where}, {camera}, {key}",
                expected=np.round(first[key], 4).tolist(),
                found=np.round(found[key], 4).tolist(),
                fix="Train with --set unproject=false, or only on episodes with equal camera calibration.",
            )

    def _choose_object_texts(self, scenes: list[SceneObjects]) -> None:
        """Choose an instruction for each object, from an episode whose target has the class of the object."""
        most = max(len(objects.classes) for objects in scenes)
        names = sorted({objects.target for objects in scenes} - {""})
        named = {name: [index for index, objects in enumerate(scenes) if objects.target == name] for name in names}
        self._classes = torch.full((len(scenes), most), -1)
        self._object_texts = torch.zeros((len(scenes), most), dtype=torch.int64)
        self._object_heights = torch.full((len(scenes), most), torch.nan)
        self._object_pixels = {
            camera: torch.full((len(self._state), most, 2), torch.nan) for camera in scenes[0].pixels
        }
        start = 0
        for index, objects in enumerate(scenes):
            self._object_heights[index, : len(objects.classes)] = torch.from_numpy(objects.points[:, 2]).float()
            for column, name in enumerate(objects.classes):
                if name in named:
                    self._classes[index, column] = names.index(name)
                    self._object_texts[index, column] = named[name][(index + column) % len(named[name])]
            for camera, pixels in objects.pixels.items():
                rows = self._object_pixels[camera][start : start + len(pixels)]
                rows[:, : len(objects.classes)] = torch.from_numpy(pixels)
            start += objects.steps


def _check_memory(config: SmallConfig, count: int, path: Path) -> None:
    processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # of accelerate launch; each process keeps all images
    needed = processes * count * sum(3 * view.size[0] * view.size[1] for view in config.views.values())
    free = psutil.virtual_memory().available
    if needed > 0.9 * free:
        raise DatasetError(
            "the images of the dataset do not fit into memory",
            where=path,
            expected=f"{needed / 1e9:.1f} GB of free memory",
            found=f"{free / 1e9:.1f} GB",
            fix="Set a smaller views.CAMERA.size, or train on fewer episodes (robocas split).",
        )


def _height_statistics(state: NDArray[np.floating], keys: NDArray[np.floating]) -> dict[str, float]:
    """Return the mean and standard deviation of the heights of key poses in the arm's base frame, m.

    state: (N, 10) proprioception. keys: (N, 9) next key poses in the TCP frame.
    """
    x, y = state[:, 3:6], state[:, 6:9]
    axes = np.stack([x[:, 2], y[:, 2], np.cross(x, y)[:, 2]], axis=1)  # the last row of the TCP's rotation
    heights = (axes * keys[:, :3]).sum(axis=1) + state[:, 2]
    return {"mean": float(heights.mean()), "deviation": max(float(heights.std()), _MIN_HEIGHT_DEVIATION)}


def _text_statistics(embeddings: NDArray[np.floating]) -> dict[str, Any]:
    """Return ``mean`` and ``deviation`` of a `Normalizer` for instruction embeddings (N, 384).

    The instructions of a task differ only in the name of the object. This name changes a component by about 0.01.
    """
    return {
        "mean": embeddings.mean(0).tolist(),
        "deviation": np.maximum(embeddings.std(0), _MIN_TEXT_DEVIATION).tolist(),
    }


def _can_scale(size: tuple[int, int], view: CameraView) -> bool:
    """Return whether images of this size (width, height) can be scaled down to ``view.image_size``."""
    width, height = view.image_size
    return size[0] * height == size[1] * width and size[0] >= width


def _make_size_error(size: tuple[int, int], view: CameraView, where: object, options: str = "") -> DatasetError:
    """Make the error for images of a wrong size (width, height); ``options``: the options to train with this size."""
    (width, height), found = view.image_size, f"{size[0]} x {size[1]}"
    fix = f"Convert again with `robocas convert --size {width} {height}`" + (options and f", or train with `{options}`")
    return DatasetError("wrong image size", where=where, expected=f"{width} x {height}", found=found, fix=f"{fix}.")


def _check_image_sizes(sizes: Mapping[str, tuple[int, int]], views: Mapping[str, CameraView], where: object) -> None:
    """Raise DatasetError if the images of a camera can't be scaled to its view.

    Args:
        sizes: width and height of the images in the dataset, by camera.
        views: the view of each camera.
        where: the dataset; the error shows it.
    """
    wrong = [camera for camera, view in views.items() if not _can_scale(sizes[camera], view)]
    if wrong:
        sets = (f"--set views.{camera}.image_size=[{sizes[camera][0]},{sizes[camera][1]}]" for camera in wrong)
        raise _make_size_error(sizes[wrong[0]], views[wrong[0]], where, " ".join(sets))


def crop_image(image: NDArray[Any], view: CameraView, where: object = "") -> NDArray[Any]:
    """Crop an image (H, W, 3) and scale it to the size of a view (h, w, 3).

    Raises:
        DatasetError: the image has another aspect ratio than ``view.image_size`` or is smaller; ``where`` is in the
            message.
    """
    width, height = view.image_size
    if image.shape[1::-1] != (width, height):
        size = image.shape[1], image.shape[0]
        if not _can_scale(size, view):
            raise _make_size_error(size, view, where)
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    left, top, right, bottom = view.crop_box()
    crop = image[top:bottom, left:right]
    smaller = crop.shape[1] >= view.size[0]
    return np.ascontiguousarray(
        cv2.resize(crop, view.size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    )
