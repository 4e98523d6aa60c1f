"""A dataset's pictures, decoded once and kept in memory, with the poses that the network is to predict."""

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

from robocas_ms3.baselines.baseline import Batch, OnRead, Split, no_episodes
from robocas_ms3.baselines.chunks import encode, next_keys, spread, state_of
from robocas_ms3.baselines.dataset_checks import DatasetNeeds, check_dataset
from robocas_ms3.baselines.small.config import SmallConfig, View
from robocas_ms3.baselines.small.pointing import places_of
from robocas_ms3.baselines.small.standing import Standing, calibration, looks_alike, seen_from, standing
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import Array, from_xyzw
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.sources.protocol import EpisodeSource

_log = logging.getLogger(__name__)
_LEAST_HEIGHT = 0.01  # m
_LEAST_WORD = 0.01  # deviation of a number of an embedding; all are 0.05 or so
_KEYS = ("ee_pos", "ee_orn", "gripper_width", "gripper_status", "base_pos", "base_orn")


class SmallSamples:
    """Samples of `small`, one of every step.

    Args:
        config: what is looked at and predicted.
        path: of the dataset.
        split: of it.
        on_read: see `Baseline.data`.

    Raises:
        DatasetError: the dataset lacks a camera or embeddings, is of another rate or damaged, its pictures are smaller
            than asked for, or all of them are more than memory holds.
    """

    def __init__(
        self,
        config: SmallConfig,
        path: Path,
        split: Split,
        on_read: OnRead = lambda done, of: None,
    ) -> None:
        source = open_source(path)
        options = "--set views.CAMERA=null", "--set language=false"
        numbers = source.split(split)
        needs = DatasetNeeds("small", list(config.views), config.rate_hz, config.language, *options)
        check_dataset(source, numbers, needs)
        self.episodes = len(numbers)
        if not numbers:
            raise no_episodes(path, split)
        seen = source.episode(numbers[0])
        first_pictures = {camera: seen.rgb(camera, 0) for camera in config.views}
        sizes = {camera: (picture.shape[1], picture.shape[0]) for camera, picture in first_pictures.items()}
        bases = seen.read(["base_pos", "base_orn"])
        self._calibration = {
            camera: calibration(seen, camera, bases, sizes[camera], view) for camera, view in config.views.items()
        }
        first = np.concatenate([[0], np.cumsum([source.lengths[number] for number in numbers])])
        count = int(first[-1])
        _check_room(config, count, path)
        self._pictures = {
            camera: torch.empty((count, view.size[1], view.size[0], 3), dtype=torch.uint8)
            for camera, view in config.views.items()
        }
        self._state = torch.empty((count, 10))
        self._chunks = torch.empty((count, config.chunk, 10))
        self._keys = torch.empty((count, 9))
        self._places = {camera: torch.empty((count, 2)) for camera in config.views}
        self._words = torch.zeros((len(numbers), 384))
        self._episode = torch.from_numpy(np.repeat(np.arange(len(numbers)), np.diff(first)))

        def read(place: int) -> Standing:
            return self._read(config, source, numbers[place], place, int(first[place]))

        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            stood: list[Standing] = []
            for done, found in enumerate(pool.map(read, range(len(numbers))), start=1):
                stood.append(found)
                on_read(done, len(numbers))
        self._ask(stood if config.language else [replace(one, target="") for one in stood])
        if config.language and split == "train" and not (self._kinds >= 0).any():
            what = "no scene.json tells where objects stood, so that only what is gripped next is pointed at"
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
        """A batch of B samples.

        Seen are pictures by camera (B, h, w, 3) uint8, ``state`` (B, 10) and ``words`` (B, 384). To be predicted are
        ``chunk`` (B, K, 10), ``key`` (B, 9), where that is seen, ``CAMERA_place`` (B, 2), and where each of N objects
        is, ``CAMERA_places`` (B, N, 2) and ``heights`` (B, N) in the arm's base, when ``asked`` (B, N, 384) for one of
        its ``kinds`` (B, N), -1 = not asked for.
        """
        rows = torch.tensor(indices)
        episodes = self._episode[rows]
        return {
            **{camera: pictures[rows] for camera, pictures in self._pictures.items()},
            **{f"{camera}_place": places[rows] for camera, places in self._places.items()},
            **{f"{camera}_places": places[rows] for camera, places in self._standing.items()},
            "kinds": self._kinds[episodes],
            "heights": self._heights[episodes],
            "asked": self._words[self._asked[episodes]],
            "state": self._state[rows],
            "words": self._words[episodes],
            "chunk": self._chunks[rows],
            "key": self._keys[rows],
        }

    def _ask(self, stood: list[Standing]) -> None:
        """What can be asked about each episode's objects, in the words of episodes of which they were the target.

        Without targets, as without language, nothing can.
        """
        most = max(len(one.kinds) for one in stood)
        names = sorted({one.target for one in stood} - {""})
        told = {name: [place for place, one in enumerate(stood) if one.target == name] for name in names}
        self._kinds = torch.full((len(stood), most), -1)
        self._asked = torch.zeros((len(stood), most), dtype=torch.int64)
        self._heights = torch.full((len(stood), most), torch.nan)
        self._standing = {
            camera: torch.full((len(self._state), most, 2), torch.nan) for camera in (stood[0].places if stood else ())
        }
        first = 0
        for place, one in enumerate(stood):
            self._heights[place, : len(one.kinds)] = torch.from_numpy(one.points[:, 2]).float()
            for column, kind in enumerate(one.kinds):
                if kind in told:
                    self._kinds[place, column] = names.index(kind)
                    self._asked[place, column] = told[kind][(place + column) % len(told[kind])]
            for camera, places in one.places.items():
                self._standing[camera][first : first + len(places), : len(one.kinds)] = torch.from_numpy(places)
            first += one.steps

    def _read(self, config: SmallConfig, source: EpisodeSource, number: int, place: int, first: int) -> Standing:
        episode = source.episode(number)
        arrays = episode.read([*_KEYS, *(["language_embedding"] if config.language else [])])
        length = source.lengths[number]
        for key, array in arrays.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                fix = "robocas validate says more."
                raise DatasetError("not a number", where=f"{source.root}, episode {number}, {key}", fix=fix)
        poses = from_xyzw(arrays["ee_pos"].astype(np.float64), arrays["ee_orn"].astype(np.float64))
        opened, rows = arrays["gripper_status"].reshape(-1), slice(first, first + length)
        self._state[rows] = torch.from_numpy(state_of(poses, arrays["gripper_width"].reshape(-1)))
        self._chunks[rows] = torch.from_numpy(encode(poses, opened, config.chunk))
        keys = next_keys(poses, opened)
        at_keys = (poses[:, :3, :3] @ keys[:, :3, None])[..., 0] + poses[:, :3, 3]  # in the arm's base
        self._keys[rows] = torch.from_numpy(keys)
        if config.language:
            self._words[place] = torch.from_numpy(arrays["language_embedding"])
        looks: dict[str, Callable[[Array], NDArray[np.float32]]] = {}
        for camera, view in config.views.items():
            with closing(episode.frames(camera, "rgb", 0, length)) as pictures:
                stored = (0, 0)
                for row, picture in enumerate(pictures, start=first):
                    self._pictures[camera][row] = torch.from_numpy(crop_image(picture, view, source.root))
                    stored = picture.shape[1], picture.shape[0]
            self._check(config, camera, calibration(episode, camera, arrays, stored, view), episode.where)
            points = seen_from(episode.camera_parent(camera), at_keys[:, None], poses, arrays)[:, 0]
            looks[camera] = partial(
                places_of,
                camera=episode.camera_in_parent(camera),
                intrinsic=episode.intrinsic(camera),
                stored=stored,
                view=view,
            )
            self._places[camera][rows] = torch.from_numpy(looks[camera](points))
        return standing(episode, arrays, poses, looks)

    def _check(self, config: SmallConfig, camera: str, found: dict[str, Any], where: object) -> None:
        """See that a camera looks in all episodes as in the first."""
        first = self._calibration[camera]
        if config.lift and not looks_alike(first, found):
            key = "mount" if not looks_alike(first, found, ["mount"]) else "intrinsic"
            raise DatasetError(
                "a camera looks another way than in other episodes, or is fixed in the world and the arm is not",
                where=f"{where}, {camera}, {key}",
                expected=np.round(first[key], 4).tolist(),
                found=np.round(found[key], 4).tolist(),
                fix="Train with --set lift=false, or on episodes of one calibration.",
            )


def _check_room(config: SmallConfig, count: int, path: Path) -> None:
    processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # of accelerate launch, each of which keeps all of them
    needed = processes * count * sum(3 * view.size[0] * view.size[1] for view in config.views.values())
    free = psutil.virtual_memory().available
    if needed > 0.9 * free:
        raise DatasetError(
            "more pictures than memory holds",
            where=path,
            expected=f"{needed / 1e9:.1f} GB",
            found=f"{free / 1e9:.1f} GB free",
            fix="Choose smaller views, or fewer episodes (robocas split).",
        )


def _spread_of_heights(state: NDArray[np.floating], keys: NDArray[np.floating]) -> dict[str, float]:
    """Mean and deviation of the heights of key poses (N, 9) in the arm's base, m, where the arm feels (N, 10)."""
    x, y = state[:, 3:6], state[:, 6:9]
    axes = np.stack([x[:, 2], y[:, 2], np.cross(x, y)[:, 2]], axis=1)  # the last row of the TCP's turn
    heights = (axes * keys[:, :3]).sum(axis=1) + state[:, 2]
    return {"mean": float(heights.mean()), "deviation": max(float(heights.std()), _LEAST_HEIGHT)}


def _spread_of_words(words: NDArray[np.floating]) -> dict[str, Any]:
    """Arguments of a `Scale` of embeddings (N, 384).

    Instructions of a task differ in a name: a hundredth of what they have in common, and all that matters.
    """
    return {"mean": words.mean(0).tolist(), "deviation": np.maximum(words.std(0), _LEAST_WORD).tolist()}


def crop_image(picture: NDArray[Any], view: View, where: object = "") -> NDArray[Any]:
    """The part (h, w, 3) of a picture (H, W, 3) that is looked at, scaled by areas.

    Raises:
        DatasetError: the picture is smaller than the view wants it, or of another shape.
    """
    width, height = view.rendered
    if picture.shape[1::-1] != (width, height):
        if picture.shape[1] * height != picture.shape[0] * width or picture.shape[1] < width:
            fix = f"robocas convert --size {width} {height}, or change views."
            found = f"{picture.shape[1]} x {picture.shape[0]}"
            raise DatasetError(
                "pictures of another size", where=where, expected=f"{width} x {height}", found=found, fix=fix
            )
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    left, top, right, bottom = view.box()
    part = picture[top:bottom, left:right]
    smaller = part.shape[1] >= view.size[0]
    return np.ascontiguousarray(
        cv2.resize(part, view.size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    )
