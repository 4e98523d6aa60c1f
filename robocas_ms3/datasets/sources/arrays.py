"""Arrays of an episode: computed from a recording, or read and cast to the schema."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, open_npz
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.files import SEE_VALIDATE
from robocas_ms3.demos.recordings.motion import Motion, compute_agv_motion, to_dataset_motion
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.robots.quantities import QUANTITIES

SPECS = {spec.name: spec for spec in schema.EPISODE_INFO}
PICKLED = "pickled objects, which are never loaded"
_IDENTITY = ("ee_pos", "ee_orn", "robot_joints", "gripper_status", "language_goal", "step_lang_goals")


@dataclass(frozen=True)
class EpisodeArrays:
    """Arrays of an ``episode_info.npz``, and the errors of arrays that can't be read.

    Attributes:
        path: path of the file.
        arrays: arrays by key.
        unreadable: error of each unreadable array, by key; key "": error of the whole file.
        derived: for each array that `derive_missing_arrays` has computed, what it was computed from.
        ignored: keys in the file that were not requested.
    """

    path: Path
    arrays: Mapping[str, NDArray]
    unreadable: Mapping[str, Exception] = field(default_factory=dict)
    derived: Mapping[str, str] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()

    @property
    def file(self) -> str:
        """Path of the file relative to the dataset."""
        return f"{self.path.parent.name}/{self.path.name}"

    @property
    def steps(self) -> int:
        """Number of steps T: the length of ``ee_pos``, or the most frequent length."""
        lengths = {key: len(array) for key, array in self.arrays.items() if array.ndim}
        most = Counter(lengths.values()).most_common(1)
        return lengths.get("ee_pos", most[0][0] if most else 0)

    def describe_error(self, key: str = "") -> str:
        """Return why the array ``key`` (default: the whole file) can't be read."""
        error = self.unreadable[key]
        text = getattr(error, "strerror", None) or one_line(error)
        pickled = PICKLED if key else f"another file, or {PICKLED}"
        return pickled if "pickle" in text else text

    def require(self, keys: Iterable[str]) -> dict[str, NDArray]:
        """Return the arrays with these keys; raise DatasetError if one is missing or any array is unreadable."""
        for key, error in self.unreadable.items():
            where, found = f"{self.path}, {key}" if key else self.path, self.describe_error(key)
            raise DatasetError("this episode can't be read", where=where, found=found, fix=SEE_VALIDATE) from error
        missing = [key for key in keys if key not in self.arrays]
        if missing:
            raise DatasetError("arrays are missing", where=self.path, expected=", ".join(missing), fix=SEE_VALIDATE)
        return {key: self.arrays[key] for key in keys}


def read_arrays(path: Path, keys: Container[str] | None = None) -> EpisodeArrays:
    """Read the arrays with these keys (default: all), without casts; errors go to ``unreadable``."""
    arrays: dict[str, NDArray] = {}
    unreadable: dict[str, Exception] = {}
    ignored: list[str] = []
    try:
        with open_npz(path) as content:
            for key in content.files:
                if keys is not None and key not in keys:
                    ignored.append(key)
                    continue
                try:
                    arrays[key] = content[key]
                    if not isinstance(arrays[key], np.ndarray):  # other members of the archive are read as bytes
                        unreadable[key] = ValueError("not an array")
                        del arrays[key]
                except (*DAMAGED_FILE_ERRORS, MemoryError) as error:
                    unreadable[key] = error
    except DAMAGED_FILE_ERRORS as error:
        unreadable[""] = error
    return EpisodeArrays(path, arrays, unreadable, ignored=tuple(ignored))


def load_arrays(path: Path) -> EpisodeArrays:
    """Read the arrays of the schema and cast them to its types.

    Arrays that can't be read or cast go to ``unreadable``. An unreadable file raises DatasetError.
    """
    stored = read_arrays(path, SPECS)
    if "" in stored.unreadable:
        error = stored.unreadable[""]
        if isinstance(error, FileNotFoundError):
            raise DatasetError("no such file", where=path) from error
        raise DatasetError(
            "damaged numpy archive, or another kind of file", where=path, found=stored.describe_error()
        ) from error
    arrays: dict[str, NDArray] = {}
    unreadable = dict(stored.unreadable)
    for key, array in stored.arrays.items():
        try:
            arrays[key] = cast_array(SPECS[key], array)
        except (ValueError, MemoryError) as error:
            unreadable[key] = error
    return replace(stored, arrays=arrays, unreadable=unreadable)


def cast_array(spec: schema.ArraySpec, array: NDArray) -> NDArray:
    """Cast an array to the data type of the schema, and drop additional axes of length 1.

    Raises:
        ValueError: the cast would change values, or the number of axes is wrong.
    """
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


def matches_schema(key: str, array: NDArray) -> bool:
    """Return whether an array has the data type and the number of axes of the schema."""
    return SPECS[key].has_dtype(array) and array.ndim == len(SPECS[key].shape)


def derive_missing_arrays(loaded: EpisodeArrays, info: Mapping[str, Any], rate_hz: float) -> EpisodeArrays:
    """Compute missing arrays from other arrays and from ``data_info.json``; return all arrays.

    ``info``: entries of the episode in ``data_info.json``, see `files.episode_info`.
    """
    arrays, derived = dict(loaded.arrays), dict(loaded.derived)

    def put(key: str, values: Any, source: str) -> None:
        if key not in arrays:
            arrays[key] = SPECS[key].cast(values)
            derived[key] = source

    if "ee_pos" in arrays:
        put("episode_length", len(arrays["ee_pos"]), "the length of the arrays")
    if isinstance(info.get("language_goal"), str):
        put("language_goal", info["language_goal"], schema.DATA_INFO_FILE)
    goals = _expand_goals(info.get("step_goals"), len(arrays.get("ee_pos", ())))
    if goals:
        put("step_goal_type", [kind for kind, _ in goals], schema.DATA_INFO_FILE)
        put("step_lang_goals", [text for _, text in goals], schema.DATA_INFO_FILE)
    for keys in schema.RELATIVE_PAIRS:
        if not set(keys[2:]) <= arrays.keys() and _read_poses(arrays, *keys[:2]) is not None:
            arrays |= compute_motion_arrays(arrays, keys)
            derived |= dict.fromkeys(keys[2:], ", ".join(keys[:2]))
    base = _read_poses(arrays, "base_pos", "base_orn")
    if base is not None:
        yaw = np.arctan2(base[:, 1, 0], base[:, 0, 0])
        put("agv_pose", np.column_stack([base[:, :2, 3], np.unwrap(yaw)]), "base_pos, base_orn")
    if arrays.get("agv_pose", np.zeros(0)).shape[1:] == (3,):
        put("rel_agv_pose", compute_agv_motion(arrays["agv_pose"]), "agv_pose")
    joints = arrays.get("robot_joints", np.zeros((0, 7)))
    if len(joints) > 1:
        put("arm_joint_vel", np.gradient(joints.astype(np.float64), axis=0) * rate_hz, "differences of robot_joints")
    return replace(loaded, arrays=arrays, derived=derived)


def compute_motion_arrays(arrays: Mapping[str, NDArray], keys: tuple[str, str, str, str]) -> dict[str, NDArray]:
    """Compute both arrays of relative motion from poses; ``keys``: one of ``schema.RELATIVE_PAIRS``."""
    poses = _read_poses(arrays, keys[0], keys[1])
    assert poses is not None
    intended = _read_poses(arrays, *schema.INTENDED_POSE) if keys == schema.RELATIVE_PAIRS[0] else None
    return dict(zip(keys[2:], to_dataset_motion(poses, intended), strict=True))


def fingerprint_arrays(arrays: Mapping[str, NDArray]) -> str:
    """Compute the SHA-256 of the arrays of an episode; it identifies an episode with an unknown recording."""
    digest = hashlib.sha256()
    for key in _IDENTITY:
        if key in arrays:
            array = arrays[key]
            data = "\n".join(map(str, array.ravel().tolist())).encode() if array.dtype.kind == "U" else array.tobytes()
            digest.update(f"{key} {array.shape}\n".encode() + data)
    return digest.hexdigest()


def _read_poses(arrays: Mapping[str, NDArray], position: str, orientation: str) -> NDArray[np.float64] | None:
    """Make poses (T, 4, 4) from two arrays; None if they are missing or invalid."""
    if not {position, orientation} <= arrays.keys():
        return None
    p, q = (arrays[key].astype(np.float64) for key in (position, orientation))
    if p.shape[1:] != (3,) or q.shape[1:] != (4,) or len(p) != len(q) or not len(p):
        return None
    if not (np.isfinite(p).all() and np.isfinite(q).all() and np.linalg.norm(q, axis=1).min() > 0.5):
        return None
    return from_xyzw(p, q)


def _expand_goals(goals: Any, steps: int) -> list[tuple[str, str]]:
    """Return (type, text) of the sub-goal of each step; empty if ``goals`` do not cover all steps.

    ``goals``: list in ``step_goals`` of ``data_info.json``.
    """
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


def make_episode_arrays(motion: Motion, instruction: str, subgoals: Sequence[SubGoal]) -> dict[str, np.ndarray]:
    """Make the arrays of ``episode_info.npz`` without embeddings, from the motion at T sampled states."""
    of_steps = [goal for goal in subgoals for _ in range(goal.last - goal.first + 1)]
    recorded = {quantity.name: quantity.record(motion) for quantity in QUANTITIES if quantity.record}
    values = {
        **{name: rows for name, rows in recorded.items() if rows is not None},
        "episode_length": len(motion.qpos),
        "language_goal": instruction,
        "step_lang_goals": [goal.goal_description for goal in of_steps],
        "step_goal_type": [goal.goal_type for goal in of_steps],
    }
    return {spec.name: spec.cast(values[spec.name]) for spec in schema.EPISODE_INFO if spec.name in values}


def add_embeddings(arrays: Mapping[str, NDArray], embed: Callable[[list[str]], NDArray]) -> dict[str, NDArray]:
    """Add the embeddings of the texts in the arrays; ``embed`` maps N texts to (N, 384)."""
    made = {
        **arrays,
        "language_embedding": embed([str(arrays["language_goal"])])[0],
        "step_goal_embs": embed(arrays["step_lang_goals"].tolist()),
    }
    return {spec.name: spec.cast(made[spec.name]) for spec in schema.EPISODE_INFO if spec.name in made}
