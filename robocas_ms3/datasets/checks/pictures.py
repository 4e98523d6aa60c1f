"""Checks what an episode's cameras saw: intrinsics and poses, the pictures' files, depth against both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import depth as geometry
from robocas_ms3.datasets.checks.content import NO_FILE, SURPLUS, EpisodeContent, Headers
from robocas_ms3.datasets.checks.rigid import is_rigid
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.pictures.headers import PictureHeader
from robocas_ms3.datasets.pictures.stored import Pictures

_HEADERS = {"rgb": (8, 3), "depth": (16, 1)}
Sizes = Mapping[str, tuple[int, int]]
"""Camera -> width and height of its pictures."""


def check_cameras(content: EpisodeContent, pictures: Pictures) -> Iterator[Violation]:
    """Check that every camera has sound intrinsics and its pose under both names, and that there are no others."""
    for camera in sorted(content.cameras - set(pictures.cameras)):
        expected = f"the cameras of {schema.CONVERSION_FILE} only"
        yield Violation(f"{content.name}/{camera}", "", expected, "another camera")
    for camera in pictures.specs:
        poses: list[NDArray] = []
        for name in (schema.INTRINSIC_FILE, *camera.pose_files):
            file = f"{content.name}/{camera.name}/{name}"
            found = content.camera_files.get(f"{camera.name}/{name}", NO_FILE)
            if isinstance(found, str):
                yield Violation(file, "", "this file" if found == NO_FILE else "a numpy array", found)
                continue
            wrong = list(check_camera_file(file, found, pose=name in camera.pose_files))
            yield from wrong
            poses += [found] if name in camera.pose_files and not wrong else []
        if len(poses) == 2 and not np.allclose(poses[0], poses[1], atol=1e-6):
            file = f"{content.name}/{camera.name}/{camera.pose_files[1]}"
            yield Violation(file, "", f"the same as {camera.pose_files[0]}", "another pose")


def check_camera_file(file: str, array: NDArray, *, pose: bool) -> Iterator[Violation]:
    """Check a camera's pose (4, 4), or its intrinsics (4,)."""
    shape = (4, 4) if pose else (4,)
    if array.shape != shape or array.dtype.kind != "f":
        yield Violation(file, "", f"floats of shape {shape}", f"{array.dtype} of shape {array.shape}")
    elif pose and not is_rigid(array):
        yield Violation(file, "", "a rigid transform", "another matrix")
    elif not pose and not (np.isfinite(array) & (array > 0)).all():
        yield Violation(file, "", "fx, fy, cx, cy > 0", str(array.tolist()))


def sizes_of(headers: Headers) -> dict[str, tuple[int, int]]:
    """The size of each camera's first sound picture."""
    found: dict[str, tuple[int, int]] = {}
    for place, inside in headers.items():
        for header in inside.values():
            if isinstance(header, PictureHeader):
                found.setdefault(place.split("/")[0], (header.width, header.height))
    return found


def check_pictures(headers: Headers, folder: str, pictures: Pictures, sizes: Sizes) -> Iterator[Violation]:
    """Check that there is a sound picture of every step, all of one size, and nothing else.

    Args:
        headers: of the pictures.
        folder: name of the episode's.
        pictures: what ``conversion.json`` promises.
        sizes: of each camera's pictures, where none is promised.
    """
    for place, inside in headers.items():
        camera, kind = place.split("/")
        wanted = [name for name, header in inside.items() if header != SURPLUS]
        for name, header in inside.items():
            file = f"{folder}/{place}/{name}"
            if header == NO_FILE:
                yield Violation(file, "", "a picture of every step", NO_FILE)
            elif header == SURPLUS:
                yield Violation(
                    file, "", f"{count_of(len(wanted), 'picture')} from {min(wanted, default='none')}", SURPLUS
                )
            elif isinstance(header, str):
                yield Violation(file, "", "a sound picture", header)
            elif header is not None:
                expected = PictureHeader(*(pictures.size or sizes[camera]), *_HEADERS[kind])
                if header != expected:
                    yield Violation(file, "", str(expected), str(header))


def check_depth(content: EpisodeContent, pictures: Pictures) -> Iterator[Violation]:
    """Check depth at some steps against intrinsics and poses, see `geometry.check`; all of these have to be sound."""
    arrays = {key: array.astype(np.float64) for key, array in content.stored.arrays.items() if array.dtype.kind == "f"}
    base = from_xyzw(arrays["base_pos"], arrays["base_orn"])
    ee = base @ from_xyzw(arrays["ee_pos"], arrays["ee_orn"])
    views: list[list[geometry.View]] = []
    for step, images in content.depth.items():
        parents = {"ee": ee[step], "arm_base": base[step], "world": np.eye(4)}
        views.append([])
        for camera in pictures.specs:
            file, image = f"{content.name}/{camera.name}/depth/{step:04d}.png", images[camera.name]
            if image is None:
                yield Violation(file, "", "a sound picture", "damage")
                return
            if not image.any():
                yield Violation(file, "", "depth", "only zeros")
            intrinsic, pose = (
                np.asarray(content.camera_files[f"{camera.name}/{name}"], np.float64)
                for name in (schema.INTRINSIC_FILE, camera.pose_files[0])
            )
            views[-1].append(geometry.View(camera.name, image, intrinsic, parents[camera.parent] @ pose))
    steps = list(content.depth)
    for index, camera_name, expected, found in geometry.check(views):
        yield Violation(f"{content.name}/{camera_name}/depth/{steps[index]:04d}.png", "", expected, found)
