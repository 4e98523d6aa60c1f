"""What a dataset's folder holds, read once: records of JSON files and episodes, where damage is noted, not raised."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED, load_array, load_json
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.pictures.headers import PictureHeader, read_header
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.files import CAMERA_LIMIT
from robocas_ms3.datasets.sources.tolerant import EpisodeArrays, first_line, read_arrays

NO_FILE = "no file"
SURPLUS = "a file beyond them"
GEOMETRY_STEPS = 3  # of which depth is decoded
_READERS = 4  # threads: reading and checksums happen outside Python's lock

Headers = Mapping[str, Mapping[str, PictureHeader | str | None]]
"""``camera/kind`` -> file name -> header, or what is wrong with the picture; None: nothing, as far as was looked."""


@dataclass(frozen=True)
class JsonObject:
    """A file that should hold a JSON object: its content, empty where it can't be read, and why it can't."""

    content: Mapping[str, Any]
    wrong: Violation | None = None


def read_object(
    root: Path, name: str, *, expected: str = "JSON", absent: str = "this file", missing: str = NO_FILE
) -> JsonObject:
    """Read a JSON object.

    Args:
        root: the dataset.
        name: of the file there.
        expected: what a damaged one should be.
        absent: what is expected where there is none.
        missing: and what is found then.
    """
    try:
        content = load_json(root / name)
    except FileNotFoundError:
        return JsonObject({}, Violation(name, "", absent, missing))
    except (OSError, ValueError) as error:
        return JsonObject({}, Violation(name, "", expected, first_line(error)))
    if not isinstance(content, dict):
        return JsonObject({}, Violation(name, "", "an object", type(content).__name__))
    return JsonObject(content)


@dataclass(frozen=True)
class EpisodeContent:
    """What an episode's folder holds.

    Attributes:
        name: of the folder.
        stored: its arrays.
        scene: ``scene.json``.
        cameras: names of the cameras' folders that are there.
        camera_files: ``camera/file`` -> intrinsics or pose, or why it can't be read; missing ones are left out.
        headers: of the pictures.
        depth: step -> camera -> (H, W) mm of a few steps, as far as their headers are sound; None: damaged.
    """

    name: str
    stored: EpisodeArrays
    scene: JsonObject
    cameras: frozenset[str]
    camera_files: Mapping[str, NDArray | str]
    headers: Headers
    depth: Mapping[int, Mapping[str, NDArray[np.uint16] | None]]

    def without_pictures(self) -> EpisodeContent:
        """The same, small enough to keep that of every episode: no embeddings, no pictures."""
        embeddings = {spec.name for spec in schema.EPISODE_INFO if spec.embedding}
        arrays = {key: array for key, array in self.stored.arrays.items() if key not in embeddings}
        return replace(self, stored=replace(self.stored, arrays=arrays), headers={}, depth={})


def read_episode(
    folder: Path, pictures: Pictures, look: Callable[[Path], PictureHeader | None] = read_header
) -> EpisodeContent:
    """Read an episode's folder.

    Args:
        folder: its path.
        pictures: which are looked at.
        look: gives a picture's header, or None; raises ValueError or OSError where it is damaged.
    """
    stored = read_arrays(folder / schema.EPISODE_FILE)
    headers = read_headers(folder, pictures, stored.steps, look)
    return EpisodeContent(
        folder.name,
        stored,
        read_object(folder.parent, f"{folder.name}/{schema.SCENE_FILE}"),
        frozenset(camera.name for camera in schema.CAMERAS if (folder / camera.name).exists()),
        _camera_files(folder, pictures.specs),
        headers,
        _depth(folder, headers, stored.steps),
    )


def read_headers(
    folder: Path, pictures: Pictures, steps: int, look: Callable[[Path], PictureHeader | None] = read_header
) -> Headers:
    """Read the headers of an episode's pictures, of which there are `schema.MAX_STEPS` at most."""

    def of_directory(place: tuple[str, str]) -> dict[str, PictureHeader | str | None]:
        first = schema.image_path(folder, *place, 0, pictures.image_format)
        there = {path.name for path in first.parent.iterdir()} if first.parent.is_dir() else set()
        wanted = [f"{step:04d}{first.suffix}" for step in range(min(steps, schema.MAX_STEPS))]
        found = {name: _look(look, first.with_name(name)) if name in there else NO_FILE for name in wanted}
        return {**found, **dict.fromkeys(sorted(there - set(wanted)), SURPLUS)}

    places = [(camera, kind) for camera in pictures.cameras for kind in pictures.kinds]
    with ThreadPoolExecutor(_READERS) as pool:
        return {"/".join(place): found for place, found in zip(places, pool.map(of_directory, places), strict=True)}


def _look(look: Callable[[Path], PictureHeader | None], path: Path) -> PictureHeader | str | None:
    try:
        return look(path)
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or first_line(error)


def _camera_files(folder: Path, cameras: Iterable[schema.CameraSpec]) -> dict[str, NDArray | str]:
    found: dict[str, NDArray | str] = {}
    for camera in cameras:
        for name in (schema.INTRINSIC_FILE, *camera.pose_files):
            try:
                found[f"{camera.name}/{name}"] = load_array(folder / camera.name / name, CAMERA_LIMIT)
            except FileNotFoundError:
                continue
            except DAMAGED as error:
                found[f"{camera.name}/{name}"] = first_line(error)
    return found


def _depth(folder: Path, headers: Headers, steps: int) -> dict[int, dict[str, NDArray[np.uint16] | None]]:
    chosen = sorted({round(step) for step in np.linspace(0, steps - 1, GEOMETRY_STEPS)}) if steps else []
    found: dict[int, dict[str, NDArray[np.uint16] | None]] = {step: {} for step in chosen}
    for place, inside in headers.items():
        camera, kind = place.split("/")
        for step in chosen if kind == "depth" else ():
            path = schema.image_path(folder, camera, "depth", step)
            if isinstance(inside.get(path.name), PictureHeader):
                image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)  # `read_header` has checked file and size
                found[step][camera] = None if image is None else np.asarray(image, dtype=np.uint16)
    return found
