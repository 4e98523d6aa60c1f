"""Checks a dataset against the schema, and lists every violation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import geometry, schema
from robocas_ms3.datasets.check_info import check_info
from robocas_ms3.datasets.check_scene import check_ledger, check_scene, check_settings
from robocas_ms3.datasets.episode import to_matrices, wrap_angle
from robocas_ms3.datasets.picture_files import PictureHeader, read_header
from robocas_ms3.datasets.pictures import Pictures
from robocas_ms3.datasets.tolerant import DAMAGED
from robocas_ms3.datasets.violation import Violation
from robocas_ms3.demos.sampling import relative_motion
from robocas_ms3.errors import DatasetError
from robocas_ms3.language.templates import GOAL_TYPES

NORM_TOLERANCE = 1e-3
POSITION_TOLERANCE = 1e-4  # m
ANGLE_TOLERANCE = 1e-3  # rad
_HEADERS = {"rgb": (8, 3), "depth": (16, 1)}
_GEOMETRY_STEPS = 3


@dataclass(frozen=True)
class Report:
    """What was found.

    Attributes:
        episodes: how many were looked at.
        steps: how many steps they have.
        violations: every one.
    """

    episodes: int
    steps: int
    violations: list[Violation]

    def as_json(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "valid": not self.violations,
            "episodes": self.episodes,
            "steps": self.steps,
            "violations": [asdict(violation) for violation in self.violations],
        }


def validate(root: str | Path, *, on_episode: Callable[[int, int], None] | None = None) -> Report:
    """Check a dataset.

    Args:
        root: its folder.
        on_episode: called with (done, all) after each episode.

    Raises:
        DatasetError: there is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise DatasetError("no such dataset folder", where=root)
    numbers = {n: folder for folder in sorted(root.iterdir()) if (n := schema.episode_number(folder.name)) is not None}
    violations: list[Violation] = []
    pictures, wrong = check_settings(root)
    violations += wrong
    loaded: dict[int, dict[str, NDArray]] = {}
    embedded: set[bool] = set()
    sizes: dict[str, tuple[int, int]] = {}  # of each camera, width and height in the first episode
    for done, (number, folder) in enumerate(numbers.items()):
        arrays: dict[str, NDArray] = {}
        violations += _episode(folder, arrays, pictures, sizes)
        loaded[number] = {k: v for k, v in arrays.items() if not k.endswith(("_embs", "_embedding"))}
        if arrays:
            embedded.add("language_embedding" in arrays)
        if on_episode:
            on_episode(done + 1, len(numbers))
    if len(embedded) > 1:
        violations.append(Violation("", "language_embedding", "in all episodes or none", "in some"))
    violations += check_ledger(root, loaded)
    violations += check_info(root, loaded)
    steps = sum(len(arrays["ee_pos"]) for arrays in loaded.values() if np.ndim(arrays.get("ee_pos", 0)))
    return Report(len(numbers), steps, violations)


def _episode(
    folder: Path, arrays: dict[str, NDArray], pictures: Pictures, sizes: dict[str, tuple[int, int]]
) -> Iterator[Violation]:
    """Check one episode; what could be read of its arrays is put into ``arrays``."""
    file = f"{folder.name}/{schema.EPISODE_FILE}"
    try:
        with np.load(folder / schema.EPISODE_FILE, allow_pickle=False) as content:
            for key in content.files:
                try:
                    arrays[key] = content[key]
                except ValueError:
                    yield Violation(file, key, "an array without pickles", "a pickled object")
    except FileNotFoundError:
        yield Violation(file, "", "this file", "no file")
        return
    except DAMAGED as error:
        yield Violation(file, "", "a numpy archive", str(error).splitlines()[0] or type(error).__name__)
        return
    steps = _count_steps(arrays)
    sound = True
    for violation in _shapes(file, arrays, steps):
        sound = False
        yield violation
    if sound:
        yield from _quaternions(file, arrays)
        yield from _values(file, arrays)
    yield from check_scene(folder, arrays)
    cameras: dict[str, tuple[NDArray, NDArray]] = {}
    yield from _cameras(folder, cameras, pictures)
    complete = True
    for violation in _pictures(folder, steps, pictures, sizes):
        complete = False
        yield violation
    if sound and complete and pictures.depth and len(cameras) == len(pictures.cameras):
        yield from _geometry(folder, arrays, cameras, steps)


def _count_steps(arrays: dict[str, NDArray]) -> int:
    if "episode_length" in arrays and arrays["episode_length"].shape == ():
        return int(arrays["episode_length"])
    lengths = [len(array) for array in arrays.values() if array.ndim]
    return max(set(lengths), key=lengths.count) if lengths else 0


def _shapes(file: str, arrays: dict[str, NDArray], steps: int) -> Iterator[Violation]:
    embedded = any(spec.name in arrays for spec in schema.EPISODE_INFO if spec.embedding)
    for spec in schema.EPISODE_INFO:
        if spec.name not in arrays:
            if not spec.embedding or embedded:
                yield Violation(file, spec.name, "this key", "no such key")
            continue
        array = arrays[spec.name]
        if not spec.has_dtype(array):
            yield Violation(file, spec.name, spec.dtype, str(array.dtype))
        if array.shape != spec.shape_for(steps):
            yield Violation(file, spec.name, f"shape {spec.shape_for(steps)}", f"shape {array.shape}")
        elif array.dtype.kind == "f" and not np.isfinite(array).all():
            yield Violation(file, spec.name, "finite numbers", f"{np.sum(~np.isfinite(array))} others")
    for key in sorted(set(arrays) - {spec.name for spec in schema.EPISODE_INFO}):
        yield Violation(file, key, "keys of the schema only", "an unknown key")


def _quaternions(file: str, arrays: dict[str, NDArray]) -> Iterator[Violation]:
    for spec in schema.EPISODE_INFO:
        if spec.quaternion:
            error = np.abs(np.linalg.norm(arrays[spec.name], axis=1) - 1)
            if error.max() > NORM_TOLERANCE:
                row = int(error.argmax())
                yield Violation(file, spec.name, "unit quaternions", f"off by {error.max():.2g} in row {row}")
    for position, orientation, rel_position, rel_orientation in schema.RELATIVE_PAIRS:
        pairs = [(arrays[position], arrays[orientation]), (arrays[rel_position], arrays[rel_orientation])]
        if any(np.linalg.norm(q, axis=1).min() < 0.5 for _, q in pairs):
            continue  # said already
        absolute, relative = (to_matrices(p.astype(np.float64), q.astype(np.float64)) for p, q in pairs)
        shift, turn = _difference(relative_motion(absolute), relative)
        if shift.max() <= POSITION_TOLERANCE and turn.max() <= ANGLE_TOLERANCE:
            continue
        as_wxyz = [to_matrices(p.astype(np.float64), np.roll(q, -1, axis=1).astype(np.float64)) for p, q in pairs]
        other_shift, other_turn = _difference(relative_motion(as_wxyz[0]), as_wxyz[1])
        if other_shift.max() <= POSITION_TOLERANCE and other_turn.max() <= ANGLE_TOLERANCE:
            yield Violation(file, f"{orientation}, {rel_orientation}", "quaternions xyzw", "quaternions wxyz")
            continue
        for key, error, limit, unit in (
            (rel_position, shift, POSITION_TOLERANCE, "m"),
            (rel_orientation, turn, ANGLE_TOLERANCE, "rad"),
        ):
            if error.max() > limit:
                wrong = int(np.sum(error > limit))
                row = int(error.argmax())
                found = f"{wrong} of {len(error)} rows off, by {error.max():.3g} {unit} in row {row}"
                yield Violation(file, key, f"the motion between rows of {position}, {orientation}", found)


def _difference(expected: NDArray, found: NDArray) -> tuple[NDArray, NDArray]:
    """Distance in m and angle in rad, each (T,), between two lots of poses (T, 4, 4)."""
    turn = Rotation.from_matrix(np.swapaxes(expected[:, :3, :3], 1, 2) @ found[:, :3, :3]).magnitude()
    return np.linalg.norm(expected[:, :3, 3] - found[:, :3, 3], axis=1), turn


def _values(file: str, arrays: dict[str, NDArray]) -> Iterator[Violation]:
    agv = arrays["agv_pose"].astype(np.float64)
    motion = np.diff(agv, axis=0, append=agv[-1:])
    motion[:, 2] = wrap_angle(motion[:, 2])
    error = np.abs(motion - arrays["rel_agv_pose"]).max()
    if error > POSITION_TOLERANCE:
        yield Violation(file, "rel_agv_pose", "differences of agv_pose", f"off by {error:.3g}")
    width = arrays["gripper_width"]
    if width.min() < -0.005 or width.max() > 0.085:
        yield Violation(file, "gripper_width", "0 to 0.08 m", f"{width.min():.3f} to {width.max():.3f}")
    for kind in sorted(set(arrays["step_goal_type"].tolist()) - set(GOAL_TYPES)):
        yield Violation(file, "step_goal_type", f"one of {', '.join(GOAL_TYPES)}", kind)
    if not str(arrays["language_goal"]).strip():
        yield Violation(file, "language_goal", "an instruction", "nothing")
    for spec in schema.EPISODE_INFO:
        if spec.embedding and spec.name in arrays:
            error = np.abs(np.linalg.norm(arrays[spec.name], axis=-1) - 1).max()
            if error > NORM_TOLERANCE:
                yield Violation(file, spec.name, "unit length", f"off by {error:.2g}")


def _cameras(folder: Path, cameras: dict[str, tuple[NDArray, NDArray]], pictures: Pictures) -> Iterator[Violation]:
    """Check intrinsics and poses; sound ones are put into ``cameras``."""
    for spec in schema.CAMERAS:
        if spec not in pictures.specs and (folder / spec.name).exists():
            expected = f"the cameras of {schema.CONVERSION_FILE} only"
            yield Violation(f"{folder.name}/{spec.name}", "", expected, "another camera")
    for camera in pictures.specs:
        found: dict[str, NDArray] = {}
        for name, shape in ((schema.INTRINSIC_FILE, (4,)), *((name, (4, 4)) for name in camera.pose_files)):
            file = f"{folder.name}/{camera.name}/{name}"
            try:
                array = np.load(folder / camera.name / name, allow_pickle=False)
            except FileNotFoundError:
                yield Violation(file, "", "this file", "no file")
                continue
            except (OSError, ValueError, EOFError) as error:
                yield Violation(file, "", "a numpy array", str(error).splitlines()[0])
                continue
            if array.shape != shape or array.dtype.kind != "f":
                yield Violation(file, "", f"floats of shape {shape}", f"{array.dtype} of shape {array.shape}")
            elif name == schema.INTRINSIC_FILE and not (np.isfinite(array) & (array > 0)).all():
                yield Violation(file, "", "fx, fy, cx, cy > 0", str(array.tolist()))
            elif name != schema.INTRINSIC_FILE and not _is_rigid(array):
                yield Violation(file, "", "a rigid transform", "another matrix")
            else:
                found[name] = array.astype(np.float64)
        poses = [found[name] for name in camera.pose_files if name in found]
        if len(poses) == 2 and not np.allclose(poses[0], poses[1], atol=1e-6):
            file = f"{folder.name}/{camera.name}/{camera.pose_files[1]}"
            yield Violation(file, "", f"the same as {camera.pose_files[0]}", "another pose")
        elif len(found) == 3:
            cameras[camera.name] = (found[schema.INTRINSIC_FILE], poses[0])


def _is_rigid(matrix: NDArray) -> bool:
    rotation = matrix[:3, :3]
    return bool(
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        and np.linalg.det(rotation) > 0
        and np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6)
    )


def _pictures(folder: Path, steps: int, pictures: Pictures, sizes: dict[str, tuple[int, int]]) -> Iterator[Violation]:
    for camera in pictures.specs:
        for kind in pictures.kinds:
            directory = folder / camera.name / kind
            shown = f"{folder.name}/{camera.name}/{kind}"
            there = {path.name for path in directory.iterdir()} if directory.is_dir() else set()
            image_format = pictures.image_format
            wanted = {schema.image_path(folder, camera.name, kind, step, image_format).name for step in range(steps)}
            for name in sorted(wanted - there):
                yield Violation(f"{shown}/{name}", "", "a picture of every step", "no file")
            for name in sorted(there - wanted):
                yield Violation(
                    f"{shown}/{name}", "", f"{steps} pictures from {min(wanted, default='none')}", "a file beyond them"
                )
            bits, channels = _HEADERS[kind]
            for name in sorted(wanted & there):
                try:
                    header = read_header(directory / name)
                except ValueError as error:
                    yield Violation(f"{shown}/{name}", "", "a sound picture", str(error))
                    continue
                width, height = pictures.size or sizes.setdefault(camera.name, (header.width, header.height))
                expected = PictureHeader(width, height, bits, channels)
                if header != expected:
                    yield Violation(f"{shown}/{name}", "", str(expected), str(header))


def _geometry(
    folder: Path, arrays: dict[str, NDArray], cameras: dict[str, tuple[NDArray, NDArray]], steps: int
) -> Iterator[Violation]:
    base = to_matrices(arrays["base_pos"].astype(np.float64), arrays["base_orn"].astype(np.float64))
    ee = base @ to_matrices(arrays["ee_pos"].astype(np.float64), arrays["ee_orn"].astype(np.float64))
    chosen = sorted({round(step) for step in np.linspace(0, steps - 1, _GEOMETRY_STEPS)})
    seen: list[list[geometry.View]] = []
    for step in chosen:
        parents = {"ee": ee[step], "arm_base": base[step], "world": np.eye(4)}
        seen.append([])
        for camera in [camera for camera in schema.CAMERAS if camera.name in cameras]:
            intrinsic, pose = cameras[camera.name]
            path = schema.image_path(folder, camera.name, "depth", step)
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            if image is None:
                yield Violation(f"{folder.name}/{camera.name}/depth/{step:04d}.png", "", "a sound picture", "damage")
                return
            depth = np.asarray(image, dtype=np.uint16)
            if not depth.any():
                yield Violation(f"{folder.name}/{camera.name}/depth/{step:04d}.png", "", "depth", "only zeros")
            seen[-1].append(geometry.View(camera.name, depth, intrinsic, parents[camera.parent] @ pose))
    for index, camera_name, expected, found in geometry.check(seen):
        yield Violation(f"{folder.name}/{camera_name}/depth/{chosen[index]:04d}.png", "", expected, found)
