"""The LeRobot dataset v3.0 as written here, declared once: writer, reader, check, documentation and tests read it.

::

    meta/info.json                              version, rate, sizes, features
    meta/stats.json                             statistics of every numeric feature over the whole dataset
    meta/tasks.parquet                          instruction -> task_index
    meta/subtasks.parquet                       text of a sub-goal -> subtask_index
    meta/episodes/chunk-000/file-000.parquet    one row an episode: where it is, its tasks, its statistics
    meta/robocas/conversion.json                how the dataset was made, and which episode is which recording; ours
    meta/robocas/episodes.parquet               scene.json and cameras of each episode; ours
    meta/robocas/checksums.json                 SHA-256 of the files below; ours
    data/chunk-000/file-000.parquet             one row a frame
    videos/<key>/chunk-000/file-000.mp4         RGB, episodes one after the other
    depth/<camera>/chunk-000/file-000.mkv       16-bit depth, FFV1, in the same way; ours, LeRobot does not look there

Metres and radians; quaternions are xyzw.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets.schema import EPISODE_INFO
from robocas_ms3.documents import check_regular
from robocas_ms3.errors import DatasetError
from robocas_ms3.poses import from_xyzw
from robocas_ms3.recordings.motion import relative_motion
from robocas_ms3.robots.table import DEFAULT

CODEBASE_VERSION = "v3.0"
ROBOT_TYPE = "mobile_panda"  # of the default robot; another one's is its name
INFO_FILE = "meta/info.json"
STATS_FILE = "meta/stats.json"
TASKS_FILE = "meta/tasks.parquet"
SUBTASKS_FILE = "meta/subtasks.parquet"
CONVERSION_FILE = "meta/robocas/conversion.json"
SCENES_FILE = "meta/robocas/episodes.parquet"
CHECKSUMS_FILE = "meta/robocas/checksums.json"
CONTENT = ("data", "videos", "depth")
"""Folders of the files that grow with the dataset."""
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{_FILE}.parquet"
EPISODES_PATH = f"meta/episodes/{_FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{_FILE}.mp4"
DEPTH_PATH = f"depth/{{camera}}/{_FILE}.mkv"
CHUNK_FILES = 1000  # files a chunk
_FILE_LIMIT = 2**34  # bytes


@dataclass(frozen=True)
class Limits:
    """When a new file begins; an episode is never divided.

    Attributes:
        data_mb, video_mb: size of a file, 2^20 bytes; LeRobot's own.
        video_seconds: length of a video. LeRobot looks frames up by float32 seconds refuses what is off by more than
            0.1 ms, which float32 resolves up to 1024 s. At rates up to 20 Hz longer videos happen to round the same way
            (checked up to 8192 s), but nothing is gained by them.
    """

    data_mb: float = 100
    video_mb: float = 200
    video_seconds: float = 1000


@dataclass(frozen=True)
class Feature:
    """One column of the data.

    Attributes:
        key: its name.
        names: of its numbers; a single one makes a column of numbers, not of lists.
        meaning: for people.
        dtype: of LeRobot.
    """

    key: str
    names: tuple[str, ...]
    meaning: str
    dtype: str = "float32"

    @property
    def width(self) -> int:
        """How many numbers."""
        return len(self.names)

    def as_json(self) -> dict[str, Any]:
        """Its form in ``info.json``."""
        return {"dtype": self.dtype, "shape": [self.width], "names": list(self.names)}


_JOINTS = tuple(f"joint_{number}" for number in range(1, 8))
_XYZ, _XYZW = ("x", "y", "z"), ("qx", "qy", "qz", "qw")

FEATURES: tuple[Feature, ...] = (
    Feature(
        "observation.state",
        (*_XYZ, *_XYZW, *_JOINTS, "gripper_width", "agv_x", "agv_y", "agv_yaw"),
        "ee_pos (3, m), ee_orn (4, xyzw), robot_joints (7, rad), gripper_width (m), agv_pose (m, m, rad)",
    ),
    Feature("observation.joint_velocity", _JOINTS, "arm_joint_vel, rad/s"),
    Feature("observation.arm_base", (*_XYZ, *_XYZW), "base_pos (3, m), base_orn (4, xyzw)"),
    Feature("observation.gripper_open", ("gripper_open",), "gripper_status: command in force at this step, 1 = open"),
    Feature(
        "action",
        ("dx", "dy", "dz", "roll", "pitch", "yaw", "gripper_open"),
        "rel_pos (3, m); rel_orn as Euler angles xyz about fixed axes (3, rad); gripper commanded until the next step,"
        " gripper_status[t + 1], the last one repeated, 1 = open",
    ),
    Feature(
        "action.joint",
        (*_JOINTS, "gripper_open"),
        "robot_joints at the next step (7, rad), the last one repeated; gripper as in action",
    ),
    Feature("action.base", ("dx", "dy", "dyaw"), "rel_agv_pose (m, m, rad)"),
)
"""Numeric features. The keys in their meanings are those of ``episode_info.npz``."""

OUR_KEYS = tuple(feature.key for feature in FEATURES)
"""By which a dataset written here is known."""

SUBGOAL_TYPE = Feature("subgoal_type", ("type",), "type of the sub-goal pursued at this step", "string")
SUBTASK_INDEX = Feature("subtask_index", ("index",), "row of meta/subtasks.parquet: text of that sub-goal", "int64")
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""LeRobot's own features: s, and numbers within the episode, of the episode, within the dataset, of the task."""


def image_key(camera: str) -> str:
    """Name of a camera's feature."""
    return f"observation.images.{camera}"


def camera_of(key: str) -> str:
    """Camera of a feature."""
    return key.removeprefix("observation.images.")


def robot_type(scene: dict[str, Any]) -> str:
    """LeRobot's word for the robot of an episode's scene."""
    env_info = scene.get("env_info")
    kwargs = env_info.get("env_kwargs") if isinstance(env_info, dict) else None
    named = kwargs.get("robot_uids") if isinstance(kwargs, dict) else None
    return ROBOT_TYPE if named in (None, DEFAULT) else str(named)


def features_json(cameras: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """``features`` of ``info.json``; ``cameras`` by name: the video's description."""
    features = {feature.key: feature.as_json() for feature in FEATURES}
    for camera, video in cameras.items():
        shape = [video["video.height"], video["video.width"], 3]
        names = ["height", "width", "channels"]
        features[image_key(camera)] = {"dtype": "video", "shape": shape, "names": names, "info": video}
    for feature in (SUBGOAL_TYPE, SUBTASK_INDEX):
        features[feature.key] = {**feature.as_json(), "names": None}
    for key in INDICES:
        dtype = "float32" if key == "timestamp" else "int64"
        features[key] = {"dtype": dtype, "shape": [1], "names": None}
    return features


def whole_rate(rate_hz: float) -> int:
    """LeRobot's frames a second.

    Raises:
        DatasetError: not a whole number.
    """
    if rate_hz < 1 or abs(rate_hz - round(rate_hz)) > 1e-9:
        raise DatasetError(
            "LeRobot takes a whole number of frames a second", where="rate", expected="1, 2, 4, 5, ...", found=rate_hz
        )
    return round(rate_hz)


def frame_columns(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """The numeric features (T, D) of an episode, from the arrays of ``episode_info.npz``."""
    turn = Rotation.from_quat(arrays["rel_orn"].astype(np.float64)).as_euler("xyz")
    status = arrays["gripper_status"].astype(np.float32)[:, None]
    command, joints = _next(status), _next(arrays["robot_joints"])
    parts = {
        "observation.state": (
            arrays["ee_pos"], arrays["ee_orn"], arrays["robot_joints"], arrays["gripper_width"][:, None],
            arrays["agv_pose"],
        ),
        "observation.joint_velocity": (arrays["arm_joint_vel"],),
        "observation.arm_base": (arrays["base_pos"], arrays["base_orn"]),
        "observation.gripper_open": (status,),
        "action": (arrays["rel_pos"], turn, command),
        "action.joint": (joints, command),
        "action.base": (arrays["rel_agv_pose"],),
    }  # fmt: skip
    return {key: np.concatenate(part, axis=1).astype(np.float32) for key, part in parts.items()}


def robocas_arrays(
    columns: dict[str, NDArray], instruction: str, subgoals: list[str], types: list[str]
) -> dict[str, NDArray]:
    """The way back: arrays of ``episode_info.npz`` but the embeddings; relative turns come from the absolute ones."""
    state, base = columns["observation.state"], columns["observation.arm_base"]
    values: dict[str, Any] = {
        "ee_pos": state[:, :3],
        "ee_orn": state[:, 3:7],
        "robot_joints": state[:, 7:14],
        "gripper_width": state[:, 14],
        "agv_pose": state[:, 15:18],
        "arm_joint_vel": columns["observation.joint_velocity"],
        "base_pos": base[:, :3],
        "base_orn": base[:, 3:],
        "gripper_status": columns["observation.gripper_open"].reshape(-1) > 0.5,
        "rel_pos": columns["action"][:, :3],
        "rel_agv_pose": columns["action.base"],
        "episode_length": len(state),
        "language_goal": instruction,
        "step_lang_goals": subgoals,
        "step_goal_type": types,
    }
    for pos, orn, rel in (("ee_pos", "ee_orn", "rel"), ("base_pos", "base_orn", "base_rel")):
        poses = from_xyzw(values[pos].astype(np.float64), values[orn].astype(np.float64))
        motion = relative_motion(poses)
        values.setdefault(f"{rel}_pos", motion[:, :3, 3])
        values[f"{rel}_orn"] = Rotation.from_matrix(motion[:, :3, :3]).as_quat(canonical=True)
    return {spec.name: spec.cast(values[spec.name]) for spec in EPISODE_INFO if spec.name in values}


def _next(values: NDArray) -> NDArray:
    return np.concatenate([values[1:], values[-1:]])


def require_extra() -> None:
    """Check that pyarrow and PyAV are there.

    Raises:
        MissingExtraError: one is not.
    """
    import importlib.util

    from robocas_ms3.errors import MissingExtraError

    missing = [name for name in ("pyarrow", "av") if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingExtraError(
            f"LeRobot datasets need {' and '.join(missing)}", fix='Run pip install "robocas-ms3[lerobot]".'
        )


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        DocumentError: the file is not regular or is too large.
        OSError: the file cannot be read.
    """
    check_regular(path, _FILE_LIMIT)
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def content_files(root: Path) -> list[Path]:
    """Files of data, videos and depth, sorted."""
    return sorted(path for name in CONTENT for path in (root / name).rglob("*") if path.is_file())


def data_file(root: Path, pattern: str, chunk: int, file: int, **names: str) -> Path:
    """Path of one of the numbered files."""
    return root / pattern.format(chunk_index=chunk, file_index=file, **names)
