"""Checks what an episode's cameras saw: intrinsics and poses, the pictures' files, depth against both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import depth as geometry
from robocas_ms3.datasets.checks.rigid import is_rigid
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.pictures.headers import PictureHeader, read_header
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.tolerant import first_line
from robocas_ms3.poses import from_xyzw

_HEADERS = {"rgb": (8, 3), "depth": (16, 1)}
_GEOMETRY_STEPS = 3


def check_cameras(folder: Path, cameras: dict[str, tuple[NDArray, NDArray]], pictures: Pictures) -> Iterator[Violation]:
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
                yield Violation(file, "", "a numpy array", first_line(error))
                continue
            if array.shape != shape or array.dtype.kind != "f":
                yield Violation(file, "", f"floats of shape {shape}", f"{array.dtype} of shape {array.shape}")
            elif name == schema.INTRINSIC_FILE and not (np.isfinite(array) & (array > 0)).all():
                yield Violation(file, "", "fx, fy, cx, cy > 0", str(array.tolist()))
            elif name != schema.INTRINSIC_FILE and not is_rigid(array):
                yield Violation(file, "", "a rigid transform", "another matrix")
            else:
                found[name] = array.astype(np.float64)
        poses = [found[name] for name in camera.pose_files if name in found]
        if len(poses) == 2 and not np.allclose(poses[0], poses[1], atol=1e-6):
            file = f"{folder.name}/{camera.name}/{camera.pose_files[1]}"
            yield Violation(file, "", f"the same as {camera.pose_files[0]}", "another pose")
        elif len(found) == 3:
            cameras[camera.name] = (found[schema.INTRINSIC_FILE], poses[0])


def check_pictures(
    folder: Path, steps: int, pictures: Pictures, sizes: dict[str, tuple[int, int]]
) -> Iterator[Violation]:
    """Check that there is a sound picture of every step, all of one size.

    Args:
        folder: the episode.
        steps: it has.
        pictures: what ``conversion.json`` promises.
        sizes: width and height of each camera's pictures so far; where none are promised, the first one's are put here.
    """
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


def check_depth(
    folder: Path, arrays: dict[str, NDArray], cameras: dict[str, tuple[NDArray, NDArray]], steps: int
) -> Iterator[Violation]:
    """Check depth at some steps against intrinsics and poses, see `geometry.check`."""
    base = from_xyzw(arrays["base_pos"].astype(np.float64), arrays["base_orn"].astype(np.float64))
    ee = base @ from_xyzw(arrays["ee_pos"].astype(np.float64), arrays["ee_orn"].astype(np.float64))
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
