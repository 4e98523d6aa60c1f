"""Finds files of an episode that were cut off since they were written: those lack their end, so little is read."""

from __future__ import annotations

import os
from pathlib import Path

from robocas_ms3.core.documents import DAMAGED, DocumentError, check_regular, load_array, load_json
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.files import CAMERA_LIMIT
from robocas_ms3.datasets.sources.tolerant import read_arrays

_ENDS = {".png": b"\0\0\0\0IEND\xaeB\x60\x82", ".jpg": b"\xff\xd9"}


def cut_off(folder: Path, pictures: Pictures) -> Path | None:
    """The first file of an episode that is missing or was cut off; damage of another kind is for `robocas validate`.

    Args:
        folder: of the episode.
        pictures: it should hold.
    """
    length = "episode_length"
    steps = read_arrays(folder / schema.EPISODE_FILE, (length,)).arrays.get(length)
    if steps is None or steps.ndim:
        return folder / schema.EPISODE_FILE
    small = [folder / schema.SCENE_FILE]
    for camera in pictures.specs:
        small += [folder / camera.name / name for name in (schema.INTRINSIC_FILE, *camera.pose_files)]
    images = (
        schema.image_path(folder, camera, kind, step, pictures.image_format)
        for camera in pictures.cameras
        for kind in pictures.kinds
        for step in range(int(steps))
    )
    wrong = (path for path in small if not _is_readable(path))
    return next(wrong, None) or next((path for path in images if not _has_end(path)), None)


def _is_readable(path: Path) -> bool:
    try:
        load_json(path) if path.suffix == ".json" else load_array(path, CAMERA_LIMIT)
    except DAMAGED:
        return False
    return True


def _has_end(path: Path) -> bool:
    try:
        check_regular(path)
        with path.open("rb", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            if path.suffix == ".webp":  # its header says how much follows
                file.seek(4)
                return int.from_bytes(file.read(4), "little") + 8 == size
            end = _ENDS[path.suffix]
            file.seek(max(0, size - len(end)))
            return file.read() == end
    except (OSError, DocumentError):
        return False
