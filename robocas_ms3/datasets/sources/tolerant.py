"""Reads ``episode_info.npz`` of datasets made elsewhere: other types, missing keys, extra axes; never pickles."""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.arrays import wrap_angle
from robocas_ms3.errors import DatasetError
from robocas_ms3.poses import from_xyzw
from robocas_ms3.recordings.motion import relative_motion

SPECS = {spec.name: spec for spec in schema.EPISODE_INFO}
DAMAGED = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError)
"""What numpy raises for a damaged archive; NotImplementedError: damaged flags or method of a member."""
PICKLED = "pickled objects, which are never loaded"
_IDENTITY = ("ee_pos", "ee_orn", "robot_joints", "gripper_status", "language_goal", "step_lang_goals")


def first_line(error: Exception) -> str:
    """What an error says, in one line; its type where it says nothing."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


@dataclass
class Loaded:
    """What could be read.

    Attributes:
        arrays: by the schema's keys, of its types and numbers of axes.
        unreadable: key of the schema -> why it could not be read.
        derived: key -> what it was made of, see `complete`.
        ignored: keys that the schema does not know; they were not read.
    """

    arrays: dict[str, NDArray] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)
    derived: dict[str, str] = field(default_factory=dict)
    ignored: list[str] = field(default_factory=list)


def load_arrays(path: Path) -> Loaded:
    """Read the arrays that the schema knows, cast to its types.

    Raises:
        DatasetError: the file is missing, damaged, or no numpy archive.
    """
    loaded = Loaded()
    try:
        with np.load(path, allow_pickle=False) as content:
            for key in content.files:
                if key not in SPECS:
                    loaded.ignored.append(key)
                    continue
                try:
                    loaded.arrays[key] = cast(SPECS[key], content[key])
                except (*DAMAGED, MemoryError) as error:
                    text = first_line(error)
                    loaded.unreadable[key] = PICKLED if "allow_pickle" in text else text
    except FileNotFoundError as error:
        raise DatasetError("no such file", where=path) from error
    except (*DAMAGED, TypeError) as error:  # TypeError: a single array is no context
        text = first_line(error)
        found = PICKLED if "pickle" in text else text
        raise DatasetError("not a numpy archive, or a damaged one", where=path, found=found) from error
    return loaded


def cast(spec: schema.ArraySpec, array: Any) -> NDArray:
    """An array of the schema's type and number of axes; axes of length 1 too many are dropped.

    Raises:
        ValueError: it says something else.
    """
    if not isinstance(array, np.ndarray):
        raise ValueError("no array")
    for axis in reversed(range(array.ndim)):
        if array.ndim > len(spec.shape) and array.shape[axis] == 1:
            array = array.squeeze(axis)
    if array.ndim != len(spec.shape):
        raise ValueError(f"{array.ndim} axes, not {len(spec.shape)}")
    if spec.has_dtype(array):
        return array
    kind = array.dtype.kind
    if spec.dtype == "str" and kind == "S":
        return np.char.decode(array, "utf-8")
    number = kind in "bfiu"
    exact = number and spec.dtype != "float32"
    if not number or (exact and not np.array_equal(array, array.astype(spec.dtype))):
        raise ValueError(f"{array.dtype}, not {spec.dtype}")
    return array.astype(spec.dtype)


def is_declared(key: str, array: NDArray) -> bool:
    """Whether an array has the schema's type and number of axes."""
    return SPECS[key].has_dtype(array) and array.ndim == len(SPECS[key].shape)


def complete(loaded: Loaded, said: Mapping[str, Any], rate_hz: float) -> None:
    """Make what is missing of what is there; it is named in ``loaded.derived``.

    Args:
        loaded: what could be read.
        said: ``language_goal`` and ``step_goals`` of the episode in ``data_info.json``, where they are there.
        rate_hz: steps a second.
    """
    arrays = loaded.arrays

    def put(key: str, values: Any, source: str) -> None:
        if key not in arrays:
            arrays[key] = SPECS[key].cast(values)
            loaded.derived[key] = source

    if "ee_pos" in arrays:
        put("episode_length", len(arrays["ee_pos"]), "the arrays' length")
    if isinstance(said.get("language_goal"), str):
        put("language_goal", said["language_goal"], schema.DATA_INFO_FILE)
    goals = _goals_of_steps(said.get("step_goals"), len(arrays.get("ee_pos", ())))
    if goals:
        put("step_goal_type", [kind for kind, _ in goals], schema.DATA_INFO_FILE)
        put("step_lang_goals", [text for _, text in goals], schema.DATA_INFO_FILE)
    for position, orientation, rel_position, rel_orientation in schema.RELATIVE_PAIRS:
        if {position, orientation} <= arrays.keys() and not {rel_position, rel_orientation} <= arrays.keys():
            if _poses(arrays, position, orientation) is None:
                continue
            derive_motion(arrays, (position, orientation, rel_position, rel_orientation))
            loaded.derived |= dict.fromkeys((rel_position, rel_orientation), f"{position}, {orientation}")
    base = _poses(arrays, "base_pos", "base_orn")
    if base is not None:
        yaw = np.arctan2(base[:, 1, 0], base[:, 0, 0])
        put("agv_pose", np.column_stack([base[:, :2, 3], np.unwrap(yaw)]), "base_pos, base_orn")
    if "agv_pose" in arrays:
        put("rel_agv_pose", planar_motion(arrays["agv_pose"]), "agv_pose")
    joints = arrays.get("robot_joints", np.zeros((0, 7)))
    if len(joints) > 1:
        put("arm_joint_vel", np.gradient(joints.astype(np.float64), axis=0) * rate_hz, "differences of robot_joints")


def derive_motion(arrays: dict[str, NDArray], keys: tuple[str, str, str, str]) -> None:
    """Put the relative motion between absolute poses into its two keys (one of ``schema.RELATIVE_PAIRS``)."""
    poses = _poses(arrays, keys[0], keys[1])
    assert poses is not None
    motion = relative_motion(poses)
    arrays[keys[2]] = SPECS[keys[2]].cast(motion[:, :3, 3])
    arrays[keys[3]] = SPECS[keys[3]].cast(Rotation.from_matrix(motion[:, :3, :3]).as_quat(canonical=True))


def planar_motion(agv_pose: NDArray) -> NDArray[np.float64]:
    """(T, 3) differences of x, y, yaw; the last row is 0."""
    pose = agv_pose.astype(np.float64)
    motion = np.diff(pose, axis=0, append=pose[-1:])
    motion[:, 2] = wrap_angle(motion[:, 2])
    return motion


def arrays_fingerprint(arrays: Mapping[str, NDArray]) -> str:
    """SHA-256 of what was measured and said: tells duplicates where the recording is not known."""
    digest = hashlib.sha256()
    for key in _IDENTITY:
        if key in arrays:
            array = arrays[key]
            data = "\n".join(map(str, array.ravel().tolist())).encode() if array.dtype.kind == "U" else array.tobytes()
            digest.update(f"{key} {array.shape}\n".encode() + data)
    return digest.hexdigest()


def _poses(arrays: Mapping[str, NDArray], position: str, orientation: str) -> NDArray[np.float64] | None:
    """(T, 4, 4), None where they are missing or no poses."""
    if not {position, orientation} <= arrays.keys():
        return None
    p, q = (arrays[key].astype(np.float64) for key in (position, orientation))
    if p.shape[1:] != (3,) or q.shape[1:] != (4,) or len(p) != len(q) or not len(p):
        return None
    if not (np.isfinite(p).all() and np.isfinite(q).all() and np.linalg.norm(q, axis=1).min() > 0.5):
        return None
    return from_xyzw(p, q)


def _goals_of_steps(goals: Any, steps: int) -> list[tuple[str, str]]:
    """(type, text) of each step from ``step_goals`` of ``data_info.json``; empty where it does not cover them all."""
    found: list[tuple[str, str]] = []
    try:
        for goal in goals or []:
            first, last = map(int, goal["goal_range"])
            if first != len(found):
                return []
            found += [(str(goal["goal_type"]), str(goal["goal_description"]))] * (last - first + 1)
    except (KeyError, TypeError, ValueError):
        return []
    return found if len(found) == steps else []
