"""Locate the objects of an episode in its images, until the gripper command changes.

In these steps the objects are at the poses of the layout, because the scripted policy touches no object on its way to
the target.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.small.config import CameraView
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import Array, from_xyzw, inverse, transform_points
from robocas_ms3.datasets.schema import SCENE_FILE
from robocas_ms3.datasets.sources.episode_source import SourceEpisode
from robocas_ms3.robots.cameras import Parent

_TOLERANCES = {"mount": 1e-3, "intrinsic": 1e-2}  # m or 1; pixels


@dataclass(frozen=True)
class SceneObjects:
    """Objects of an episode.

    Attributes:
        steps: number of steps of the episode, T.
        target: asset id of the target; empty: unknown.
        classes: asset id of each of N objects.
        pixels: by camera, (T, N, 2) pixels of the objects in the view. NaN: the object is behind the camera, or the
            gripper command has changed before this step.
        points: (N, 3) positions of the objects in the arm's base frame at the start, m.
    """

    steps: int
    target: str = ""
    classes: list[str] = field(default_factory=list)
    pixels: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    points: NDArray[np.floating] = field(default_factory=lambda: np.zeros((0, 3)))


def locate_objects(
    episode: SourceEpisode,
    arrays: Mapping[str, NDArray[Any]],
    tcp_in_base: Array,
    projections: Mapping[str, Callable[[Array], NDArray[np.float32]]],
) -> SceneObjects:
    """Return the objects of an episode and their pixels.

    There are no objects if the dataset has no layout of the episode, or if the episode is an expert intervention: the
    other policy may have moved the objects.

    Args:
        episode: the episode.
        arrays: ``base_pos``, ``base_orn`` and ``gripper_status`` of the episode.
        tcp_in_base: (T, 4, 4) TCP poses in the arm's base frame.
        projections: by camera, function that projects points (T, N, 3) in the frame of the camera's parent to pixels
            (T, N, 2).

    Raises:
        DatasetError: ``scene.json`` is damaged.
    """
    steps = len(tcp_in_base)
    try:
        layout, target = episode.layout, episode.scene.get("target") or {}
        target_id, poses = str(target.get("asset_id") or ""), layout.get("poses")
        if not poses or "intervention" in (episode.scene.get("recorded") or {}):  # the other policy may have moved them
            nothing = np.full((steps, 0, 2), np.nan, np.float32)
            return SceneObjects(steps, target_id, pixels=dict.fromkeys(projections, nothing))
        present = np.array(layout.get("present") or [True] * len(poses), bool)
        points = np.array(poses, np.float64).reshape(-1, 7)[present, :3]
        classes = [name for name, is_present in zip(layout["object_ids"], present, strict=True) if is_present]
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        where = f"{episode.where}/{SCENE_FILE}"
        fix = "Convert the episode again."
        raise DatasetError("damaged layout of an episode", where=where, found=error, fix=fix) from error
    in_base = transform_points(inverse(_base_poses(arrays)), points[None])
    commands = arrays["gripper_status"].reshape(-1)
    unmoved = np.logical_and.accumulate(commands == commands[0])
    pixels = {
        camera: project(to_camera_parent_frame(episode.camera_parent(camera), in_base, tcp_in_base, arrays))
        for camera, project in projections.items()
    }
    for values in pixels.values():
        values[~unmoved] = np.nan
    return SceneObjects(steps, target_id, classes, pixels, in_base[0])


def read_calibration(
    episode: SourceEpisode,
    camera: str,
    arrays: Mapping[str, NDArray[Any]],
    stored_size: tuple[int, int],
    view: CameraView,
) -> dict[str, Any]:
    """Return the calibration of a camera, the argument ``camera`` of `Unproject`.

    If the parent of the camera is the world, ``mount`` is relative to the arm's base at the first step.

    Args:
        episode: an episode of the dataset.
        camera: name of the camera.
        arrays: ``base_pos`` and ``base_orn`` of the episode.
        stored_size: width and height of the images in the dataset, pixels.
        view: view of the camera.
    """
    mount, parent = episode.true_camera_in_parent(camera), episode.camera_parent(camera)
    if parent == "world":
        mount = inverse(_base_poses(arrays))[0] @ mount
    left, top, right, bottom = np.array(view.crop_box()) / np.tile(view.image_size, 2)
    scale, intrinsic = np.array(view.size) / (right - left, bottom - top), episode.intrinsic(camera)
    focal, center = intrinsic[:2] / stored_size * scale, (intrinsic[2:] / stored_size - (left, top)) * scale
    return {"on_hand": parent == "ee", "mount": mount.tolist(), "intrinsic": [*focal.tolist(), *center.tolist()]}


def calibrations_agree(first: dict[str, Any], second: dict[str, Any], keys: Sequence[str] = tuple(_TOLERANCES)) -> bool:
    """Return whether two calibrations are equal within 1 mm, 1 mrad and 0.01 pixels.

    keys: keys of the calibrations that are compared.
    """
    return all(np.allclose(first[key], second[key], rtol=0, atol=_TOLERANCES[key]) for key in keys)


def to_camera_parent_frame(
    parent: Parent, points: Array, tcp_in_base: Array, arrays: Mapping[str, NDArray[Any]]
) -> Array:
    """Transform points (T, N, 3) from the arm's base frame to the frame of a camera's parent.

    tcp_in_base: (T, 4, 4) TCP poses in the arm's base frame. arrays: ``base_pos`` and ``base_orn`` of the episode.
    """
    if parent == "ee":
        return transform_points(inverse(tcp_in_base), points)
    return transform_points(_base_poses(arrays), points) if parent == "world" else points


def _base_poses(arrays: Mapping[str, NDArray[Any]]) -> Array:
    """Return the poses (T, 4, 4) of the arm's base in the world frame."""
    return from_xyzw(arrays["base_pos"].astype(np.float64), arrays["base_orn"].astype(np.float64))
