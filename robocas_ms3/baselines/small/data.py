"""Samples of `small`: images of a dataset, decoded once and held in memory, and the poses to predict."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
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
from robocas_ms3.baselines.chunks import encode, next_keys, spread, state_of
from robocas_ms3.baselines.dataset_checks import check_dataset
from robocas_ms3.baselines.small.config import SmallConfig, View
from robocas_ms3.baselines.small.localization import project_points
from robocas_ms3.baselines.small.objects import (
    SceneObjects,
    calibration,
    in_camera_parent,
    locate_objects,
    same_calibration,
)
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import Array, from_xyzw
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.robots.quantities import GRIPPER_WIDTH

_log = logging.getLogger(__name__)
_MIN_HEIGHT_DEVIATION = 0.01  # m
_MIN_WORD_DEVIATION = 0.01  # of a number of an embedding; all are about 0.05
_KEYS = ("ee_pos", "ee_orn", GRIPPER_WIDTH, "gripper_status", "base_pos", "base_orn")


class SmallSamples:
    """Samples of `small`, one of every step."""

    def __init__(self, config: SmallConfig, path: Path, split: Split, on_read: OnRead) -> None:
        self._config, self._source = config, open_source(path)
        source, views = self._source, config.views
        numbers = check_dataset(source, split, views, config.rate_hz, language=config.language)
        self.episodes = len(numbers)
        first = source.episode(numbers[0])
        shapes = {camera: first.rgb(camera, 0).shape for camera in views}
        sizes = {camera: (shape[1], shape[0]) for camera, shape in shapes.items()}
        base = first.read(["base_pos", "base_orn"])
        self._calibration = {
            camera: calibration(first, camera, base, sizes[camera], view) for camera, view in views.items()
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
        self._places = {camera: torch.empty((count, 2)) for camera in views}
        self._words = torch.zeros((len(numbers), 384))
        self._episode = torch.from_numpy(np.repeat(np.arange(len(numbers)), lengths))
        starts = (np.cumsum(lengths) - lengths).tolist()
        scenes: list[SceneObjects] = []
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            for objects in pool.map(self._read, range(len(numbers)), numbers, starts):
                scenes.append(objects)
                on_read(len(scenes), len(numbers))
        self._find_questions(scenes if config.language else [replace(objects, target="") for objects in scenes])
        if config.language and split == "train" and not (self._kinds >= 0).any():
            what = "no scene.json with the places of the objects: only the next key pose is pointed at"
            _log.warning("%s: %s", path, what)
        self.facts: dict[str, Any] = {
            "rate_hz": source.rate_hz,
            "pictures": {camera: list(size) for camera, size in sizes.items()},
            "chunk": spread(self._chunks[..., :9].numpy()),
            "keys": spread(self._keys.numpy()),
            **({"calibration": self._calibration} if config.lift else {}),
            "heights": _spread_of_heights(self._state.numpy(), self._keys.numpy()),
            "words": _spread_of_words(self._words.numpy()),
        }

    def __len__(self) -> int:
        return len(self._state)

    def __getitems__(self, indices: list[int]) -> Batch:
        """Return a batch of B samples.

        Inputs are images by camera (B, h, w, 3) uint8, ``state`` (B, 10) and ``words`` (B, 384). To predict are
        ``chunk`` (B, K, 10), ``key`` (B, 9), where that is in the image, ``CAMERA_place`` (B, 2), and where each of N
        objects is, ``CAMERA_places`` (B, N, 2) and ``heights`` (B, N) in the arm's base, for the instructions
        ``asked`` (B, N, 384) that name one of its ``kinds`` (B, N), -1 = no instruction does.
        """
        rows = torch.tensor(indices)
        episodes = self._episode[rows]
        return {
            **{camera: images[rows] for camera, images in self._images.items()},
            **{f"{camera}_place": places[rows] for camera, places in self._places.items()},
            **{f"{camera}_places": places[rows] for camera, places in self._object_places.items()},
            "kinds": self._kinds[episodes],
            "heights": self._heights[episodes],
            "asked": self._words[self._asked[episodes]],
            "state": self._state[rows],
            "words": self._words[episodes],
            "chunk": self._chunks[rows],
            "key": self._keys[rows],
        }

    def _read(self, place: int, number: int, start: int) -> SceneObjects:
        """Read the episode of a number into the rows from ``start`` on."""
        config, episode = self._config, self._source.episode(number)
        arrays = episode.read([*_KEYS, *(["language_embedding"] if config.language else [])])
        length = self._source.lengths[number]
        for key, array in arrays.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                where = f"{self._source.root}, episode {number}, {key}"
                raise DatasetError("NaN or infinite value", where=where, fix="robocas validate says more.")
        poses = from_xyzw(arrays["ee_pos"].astype(np.float64), arrays["ee_orn"].astype(np.float64))
        opened, rows = arrays["gripper_status"].reshape(-1), slice(start, start + length)
        self._state[rows] = torch.from_numpy(state_of(poses, arrays[GRIPPER_WIDTH].reshape(-1)))
        self._chunks[rows] = torch.from_numpy(encode(poses, opened, config.chunk))
        keys = next_keys(poses, opened)
        at_keys = (poses[:, :3, :3] @ keys[:, :3, None])[..., 0] + poses[:, :3, 3]  # in the arm's base
        self._keys[rows] = torch.from_numpy(keys)
        if config.language:
            self._words[place] = torch.from_numpy(arrays["language_embedding"])
        projections: dict[str, Callable[[Array], NDArray[np.float32]]] = {}
        for camera, view in config.views.items():
            stored = (0, 0)
            with closing(episode.frames(camera, "rgb", 0, length)) as images:
                for row, image in enumerate(images, start=start):
                    self._images[camera][row] = torch.from_numpy(crop_image(image, view, self._source.root))
                    stored = image.shape[1], image.shape[0]
            self._check_calibration(camera, calibration(episode, camera, arrays, stored, view), episode.where)
            projections[camera] = partial(
                project_points,
                camera=episode.camera_in_parent(camera),
                intrinsic=episode.intrinsic(camera),
                stored=stored,
                view=view,
            )
            points = in_camera_parent(episode.camera_parent(camera), at_keys[:, None], poses, arrays)[:, 0]
            self._places[camera][rows] = torch.from_numpy(projections[camera](points))
        return locate_objects(episode, arrays, poses, projections)

    def _check_calibration(self, camera: str, found: dict[str, Any], where: object) -> None:
        first = self._calibration[camera]
        if self._config.lift and not same_calibration(first, found):
            key = "mount" if not same_calibration(first, found, ["mount"]) else "intrinsic"
            raise DatasetError(
                "a camera is mounted in another way than in other episodes, or is fixed in the world unlike the arm",
                where=f"{where}, {camera}, {key}",
                expected=np.round(first[key], 4).tolist(),
                found=np.round(found[key], 4).tolist(),
                fix="Train with --set lift=false, or on episodes of one calibration.",
            )

    def _find_questions(self, scenes: list[SceneObjects]) -> None:
        """Choose an instruction for each object of each episode, of an episode whose target is of that kind."""
        most = max(len(objects.kinds) for objects in scenes)
        names = sorted({objects.target for objects in scenes} - {""})
        named = {name: [place for place, objects in enumerate(scenes) if objects.target == name] for name in names}
        self._kinds = torch.full((len(scenes), most), -1)
        self._asked = torch.zeros((len(scenes), most), dtype=torch.int64)
        self._heights = torch.full((len(scenes), most), torch.nan)
        self._object_places = {
            camera: torch.full((len(self._state), most, 2), torch.nan) for camera in scenes[0].places
        }
        start = 0
        for place, objects in enumerate(scenes):
            self._heights[place, : len(objects.kinds)] = torch.from_numpy(objects.points[:, 2]).float()
            for column, kind in enumerate(objects.kinds):
                if kind in named:
                    self._kinds[place, column] = names.index(kind)
                    self._asked[place, column] = named[kind][(place + column) % len(named[kind])]
            for camera, places in objects.places.items():
                rows = self._object_places[camera][start : start + len(places)]
                rows[:, : len(objects.kinds)] = torch.from_numpy(places)
            start += objects.steps


def _check_memory(config: SmallConfig, count: int, path: Path) -> None:
    processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # of accelerate launch; each holds all images
    needed = processes * count * sum(3 * view.size[0] * view.size[1] for view in config.views.values())
    free = psutil.virtual_memory().available
    if needed > 0.9 * free:
        raise DatasetError(
            "the images do not fit into memory",
            where=path,
            expected=f"{needed / 1e9:.1f} GB",
            found=f"{free / 1e9:.1f} GB free",
            fix="Choose smaller views, or fewer episodes (robocas split).",
        )


def _spread_of_heights(state: NDArray[np.floating], keys: NDArray[np.floating]) -> dict[str, float]:
    """Return mean and deviation of the heights of key poses (N, 9) in the arm's base, m, for states (N, 10)."""
    x, y = state[:, 3:6], state[:, 6:9]
    axes = np.stack([x[:, 2], y[:, 2], np.cross(x, y)[:, 2]], axis=1)  # the last row of the TCP's rotation
    heights = (axes * keys[:, :3]).sum(axis=1) + state[:, 2]
    return {"mean": float(heights.mean()), "deviation": max(float(heights.std()), _MIN_HEIGHT_DEVIATION)}


def _spread_of_words(words: NDArray[np.floating]) -> dict[str, Any]:
    """Return the arguments of a `Scale` of embeddings (N, 384).

    Instructions of a task differ in a name: a hundredth of what they have in common, and all that matters.
    """
    return {"mean": words.mean(0).tolist(), "deviation": np.maximum(words.std(0), _MIN_WORD_DEVIATION).tolist()}


def crop_image(image: NDArray[Any], view: View, where: object = "") -> NDArray[Any]:
    """Return the part (h, w, 3) of an image (H, W, 3) that a view shows, scaled by areas."""
    width, height = view.rendered
    if image.shape[1::-1] != (width, height):
        if image.shape[1] * height != image.shape[0] * width or image.shape[1] < width:
            found, fix = f"{image.shape[1]} x {image.shape[0]}", f"robocas convert --size {width} {height}"
            raise DatasetError(
                "images of another size",
                where=where,
                expected=f"{width} x {height}",
                found=found,
                fix=f"{fix}, or change views.",
            )
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    left, top, right, bottom = view.box()
    part = image[top:bottom, left:right]
    smaller = part.shape[1] >= view.size[0]
    return np.ascontiguousarray(
        cv2.resize(part, view.size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    )
