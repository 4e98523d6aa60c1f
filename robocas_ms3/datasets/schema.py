"""The RoboCAS folder, declared once: writer, reader, validator, documentation and tests all read it here.

::

    data_info.json                    overview and split, see `records.DataInfoRecord`
    conversion.json                   settings, and which recording became which episode; the released loader ignores it
    episode_0000000/
      scene.json                      how the episode was made, see `SceneRecord`; the released loader ignores it
      episode_info.npz                arrays over T steps, see EPISODE_INFO; holds no pickles
      <camera>/                       of each camera, see `robots.cameras`
        cam_pos_wrt_<parent>.npy      4x4 OpenCV camera frame (x right, y down, z forward) in its parent; the paper's
        cam_pose_wrt_<parent>.npy     name and upstream's, the same content
        intrinsic.npy                 (4,) fx, fy, cx, cy in pixels
        rgb/0000.png ...              8-bit RGB, one a step; jpg or webp where that was asked for
        depth/0000.png ...            16-bit grey, millimetres along the optical axis, 0 = nothing; may be left out

Metres and radians; quaternions are xyzw.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.robots.cameras import CAMERA_NAME, PARENT_FRAMES, Parent, standard_camera_parent
from robocas_ms3.robots.quantities import QUANTITIES, ArraySpec
from robocas_ms3.scenes.language.embed import DIMENSIONS
from robocas_ms3.scenes.language.templates import GOAL_TYPES

SCHEMA_VERSION = 2
"""Raised when older datasets have to be converted again. 1: no ``scene.json``; 0: upstream's, see docs/dataset.md."""

EPISODE_FILE = "episode_info.npz"
SCENE_FILE = "scene.json"
DATA_INFO_FILE = "data_info.json"
CONVERSION_FILE = "conversion.json"
PREVIEW_FOLDER = "preview"
INTRINSIC_FILE = "intrinsic.npy"
IMAGE_KINDS = ("rgb", "depth")
ImageFormat = Literal["png", "jpg", "webp"]
IMAGE_FORMATS: tuple[ImageFormat, ...] = ("png", "jpg", "webp")
"""Of RGB; the released loader opens ``png`` only. Depth is always PNG, which loses nothing."""
MAX_STEPS = 10_000  # four digits in image names


EPISODE_INFO: tuple[ArraySpec, ...] = (
    *(quantity for quantity in QUANTITIES if quantity.record),
    ArraySpec("episode_length", "int64", (), "steps", "T"),
    ArraySpec("language_goal", "str", (), "", "the instruction"),
    ArraySpec(
        "language_embedding", "float32", (DIMENSIONS,), "", "the instruction, by all-MiniLM-L6-v2", embedding=True
    ),
    ArraySpec("step_lang_goals", "str", ("T",), "", "text of the sub-goal pursued at this step"),
    ArraySpec("step_goal_type", "str", ("T",), "", "its type, one of: " + ", ".join(GOAL_TYPES)),
    ArraySpec(
        "step_goal_embs", "float32", ("T", DIMENSIONS), "", "step_lang_goals, by all-MiniLM-L6-v2", embedding=True
    ),
)
"""Arrays of ``episode_info.npz``: the recorded quantities of the robot, and texts."""

RELATIVE_PAIRS = (("ee_pos", "ee_orn", "rel_pos", "rel_orn"), ("base_pos", "base_orn", "base_rel_pos", "base_rel_orn"))
"""Keys of absolute position and orientation, and of the same as relative motion."""


def check_version(found: object, where: Path, what: str = "a dataset") -> None:
    """Raise DatasetError if the schema version of a file or folder is another."""
    if found != SCHEMA_VERSION:
        fix = "Convert it again from its recording."
        if found == 0:
            fix = "Import it first: robocas import-robocas."
        elif isinstance(found, int) and found > SCHEMA_VERSION:
            fix = "Use a newer robocas."
        raise DatasetError(
            f"{what} of another schema version", where=where, expected=SCHEMA_VERSION, found=found, fix=fix
        )


def pose_files(parent: Parent) -> tuple[str, str]:
    """Return both names of the file with the pose of a camera, by the frame that the pose is in."""
    return f"cam_pos_wrt_{parent}.npy", f"cam_pose_wrt_{parent}.npy"


def camera_parent(folder: Path) -> Parent:
    """Return the frame that the pose in a camera's folder is in, by the name of its file; without one, the usual."""
    for parent in PARENT_FRAMES:
        if any((folder / name).exists() for name in pose_files(parent)):
            return parent
    return standard_camera_parent(folder.name)


def camera_names(episode: Path) -> tuple[str, ...]:
    """Return the cameras that have a folder in an episode's folder, sorted."""
    if not episode.is_dir():
        return ()
    return tuple(sorted(p.name for p in episode.iterdir() if re.fullmatch(CAMERA_NAME, p.name) and p.is_dir()))


def episode_folder(number: int) -> str:
    return f"episode_{number:07d}"


def episode_number(folder: str) -> int | None:
    """Number of an episode's folder, None for other folders."""
    digits = folder.removeprefix("episode_")
    return int(digits) if folder.startswith("episode_") and len(digits) == 7 and digits.isdecimal() else None


def image_path(episode: Path, camera: str, kind: str, step: int, image_format: ImageFormat = "png") -> Path:
    """Path of an image; ``kind`` is ``rgb`` or ``depth``, the format that of RGB."""
    return episode / camera / kind / f"{step:04d}.{image_format if kind == 'rgb' else 'png'}"
