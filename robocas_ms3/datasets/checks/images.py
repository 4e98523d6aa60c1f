"""Checks of the cameras of an episode: intrinsics, poses, image files and depth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, load_npy
from robocas_ms3.core.poses import from_xyzw, inverse
from robocas_ms3.core.text import format_count, one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import depth as geometry
from robocas_ms3.datasets.checks.violation import NO_FILE, Violation
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.images.image_headers import ImageHeader, read_header
from robocas_ms3.datasets.sources.arrays import EpisodeArrays
from robocas_ms3.datasets.sources.files import CAMERA_LIMIT
from robocas_ms3.robots.cameras import Parent

_UNEXPECTED = "an additional file"
_INTACT = "an intact image"
_DEPTH_STEPS = 3  # steps whose depth is decoded
_READERS = 4  # threads; reading and checksums release the GIL
_MAX_SHIFT, _MAX_TURN_DEG = 0.35, 60  # more than the greatest random motion: 0.2 m and 20 degrees per axis
_HEADERS = {"rgb": (8, 3), "depth": (16, 1)}
Sizes = dict[str, tuple[int, int]]
"""Camera -> width and height of its images."""
ReadHeader = Callable[[Path], ImageHeader | None]
"""`read_header`, or `check_file_ends`, which returns None; raises ValueError or OSError for a damaged image."""


def check_cameras(folder: Path, image_options: ImageOptions) -> Iterator[Violation]:
    """Check that each camera has valid intrinsics and poses, and that there are no other cameras.

    The file of the true pose may be missing.
    """
    for camera in schema.camera_names(folder):
        if camera not in image_options.cameras:
            expected = f"the cameras listed in {schema.CONVERSION_FILE}"
            yield Violation(f"{folder.name}/{camera}", "", expected, "another camera")
    for camera in image_options.cameras:
        poses: dict[str, NDArray] = {}
        pose_files = schema.pose_files(schema.camera_parent(folder / camera))
        true_pose = schema.true_pose_file(schema.camera_parent(folder / camera))
        optional = [true_pose] if (folder / camera / true_pose).exists() else []
        for name in (schema.INTRINSIC_FILE, *pose_files, *optional):
            file = f"{folder.name}/{camera}/{name}"
            try:
                found = load_npy(folder / camera / name, CAMERA_LIMIT)
            except FileNotFoundError:
                yield Violation(file, "", "this file", NO_FILE, "missing")
                continue
            except DAMAGED_FILE_ERRORS as error:
                yield Violation(file, "", "a numpy array", one_line(error))
                continue
            wrong = list(check_camera_array(file, found, pose=name != schema.INTRINSIC_FILE))
            yield from wrong
            if not wrong:
                poses[name] = found
        first, second = pose_files
        if first in poses and second in poses and not np.allclose(poses[first], poses[second], atol=1e-6):
            yield Violation(f"{folder.name}/{camera}/{second}", "", f"the pose of {first}", "another pose")
        if first in poses and true_pose in poses:
            shift = inverse(poses[first]) @ poses[true_pose]
            distance = float(np.linalg.norm(shift[:3, 3]))
            angle = float(np.rad2deg(Rotation.from_matrix(shift[:3, :3]).magnitude()))
            if distance > _MAX_SHIFT or angle > _MAX_TURN_DEG:
                expected = f"at most {_MAX_SHIFT} m and {_MAX_TURN_DEG} degrees from the pose of {first}"
                found = f"{distance:.2f} m, {angle:.0f} degrees"
                yield Violation(f"{folder.name}/{camera}/{true_pose}", "", expected, found)


def check_camera_array(file: str, array: NDArray, *, pose: bool) -> Iterator[Violation]:
    """Check the pose (4, 4) of a camera, or its intrinsics (4,) if ``pose`` is False."""
    shape = (4, 4) if pose else (4,)
    if array.shape != shape or array.dtype.kind != "f":
        yield Violation(file, "", f"floats of shape {shape}", f"{array.dtype} of shape {array.shape}")
    elif pose and not _is_rigid(array):
        yield Violation(file, "", "a rigid transform", "another matrix")
    elif not pose and not (np.isfinite(array) & (array > 0)).all():
        yield Violation(file, "", "fx, fy, cx, cy > 0", str(array.tolist()))


def _is_rigid(matrix: NDArray) -> bool:
    rotation, last_row = matrix[:3, :3], matrix[3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
    return bool(np.isfinite(matrix).all() and is_rotation and np.allclose(last_row, [0, 0, 0, 1], atol=1e-6))


def check_images(
    folder: Path, image_options: ImageOptions, steps: int, sizes: Sizes, read: ReadHeader = read_header
) -> Iterator[Violation]:
    """Check that each step has an intact image, with one size per camera, and that there is no other file.

    ``sizes``: image size by camera; a missing size is set from the first image.
    """
    folders = [(camera, kind) for camera in image_options.cameras for kind in image_options.kinds]
    with ThreadPoolExecutor(_READERS) as pool:
        headers = list(pool.map(partial(_read_headers, folder, image_options.image_format, steps, read), folders))
    for (camera, kind), found in zip(folders, headers, strict=True):
        wanted = [name for name, header in found.items() if header != _UNEXPECTED]
        for name, header in found.items():
            file = f"{folder.name}/{camera}/{kind}/{name}"
            if header == NO_FILE:
                yield Violation(file, "", "an image of each step", NO_FILE, "missing")
            elif header == _UNEXPECTED:
                expected = f"{format_count(len(wanted), 'image')} from {min(wanted, default='none')}"
                yield Violation(file, "", expected, _UNEXPECTED, "unexpected")
            elif isinstance(header, str):
                yield Violation(file, "", _INTACT, header)
            elif header is not None:
                size = sizes.setdefault(camera, (header.width, header.height))
                expected = ImageHeader(*(image_options.size or size), *_HEADERS[kind])
                if header != expected:
                    yield Violation(file, "", str(expected), str(header))


def _read_headers(
    folder: Path, image_format: schema.ImageFormat, steps: int, read: ReadHeader, camera_and_kind: tuple[str, str]
) -> dict[str, ImageHeader | str | None]:
    first = schema.image_path(folder, *camera_and_kind, 0, image_format)
    present = {path.name for path in first.parent.iterdir()} if first.parent.is_dir() else set()
    wanted = [f"{step:04d}{first.suffix}" for step in range(min(steps, schema.MAX_STEPS))]
    found: dict[str, ImageHeader | str | None] = {}
    for name in wanted:
        try:
            found[name] = read(first.with_name(name)) if name in present else NO_FILE
        except (OSError, ValueError) as error:
            found[name] = getattr(error, "strerror", None) or one_line(error)
    return {**found, **dict.fromkeys(sorted(present - set(wanted)), _UNEXPECTED)}


def check_depth(folder: Path, stored: EpisodeArrays, image_options: ImageOptions) -> Iterator[Violation]:
    """Check that the depth images of three steps agree with the cameras, see `checks.depth`.

    All other checks of the episode must have passed.
    """
    arrays = {key: array.astype(np.float64) for key, array in stored.arrays.items() if array.dtype.kind == "f"}
    base = from_xyzw(arrays["base_pos"], arrays["base_orn"])
    ee = base @ from_xyzw(arrays["ee_pos"], arrays["ee_orn"])
    parent_of: dict[str, Parent] = {camera: schema.camera_parent(folder / camera) for camera in image_options.cameras}
    cameras = {}
    for camera, parent in parent_of.items():
        true_pose = schema.true_pose_file(parent)
        pose_file = true_pose if (folder / camera / true_pose).exists() else schema.pose_files(parent)[0]
        cameras[camera] = [
            np.asarray(load_npy(folder / camera / name, CAMERA_LIMIT), np.float64)
            for name in (schema.INTRINSIC_FILE, pose_file)
        ]
    steps = sorted({round(step) for step in np.linspace(0, stored.steps - 1, _DEPTH_STEPS)})
    views: list[list[geometry.DepthView]] = []
    for step in steps:
        parents = {"ee": ee[step], "arm_base": base[step], "world": np.eye(4)}
        views.append([])
        for camera, parent in parent_of.items():
            path = schema.image_path(folder, camera, "depth", step)
            file = f"{folder.name}/{path.relative_to(folder)}"
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)  # `check_images` has checked file and size
            if image is None:
                yield Violation(file, "", _INTACT, "a damaged image")
                return
            if not image.any():
                yield Violation(file, "", "depth > 0 in some pixels", "only zeros")
            intrinsic, pose = cameras[camera]
            camera_in_world = parents[parent] @ pose
            views[-1].append(
                geometry.DepthView(camera, image.astype(np.uint16), intrinsic, camera_in_world, parent == "ee")
            )
    for index, camera_name, expected, found in geometry.check_depth_views(views):
        yield Violation(f"{folder.name}/{camera_name}/depth/{steps[index]:04d}.png", "", expected, found)
