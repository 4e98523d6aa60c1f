"""Locate the objects of an episode in its images, until the gripper command changes.

Until that step the objects are at the poses of the layout: the scripted policy reaches its target on a free path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.small.config import View
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
        target: asset id of the target; empty: not known.
        classes: asset id of each of N objects.
        pixels: (T, N, 2) pixels in the view, by camera; NaN: behind the camera, or not known after a change of the
            gripper command.
        points: (N, 3) positions in the arm's base frame, m.
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
    """Return the objects of an episode; none without a known layout, or if another policy acted first.

    Args:
        episode: the episode.
        arrays: its ``base_pos``, ``base_orn`` and ``gripper_status``.
        tcp_in_base: (T, 4, 4) TCP poses in the arm's base frame.
        projections: by camera, function from points (T, N, 3) in the frame of its parent to pixels (T, N, 2).
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
        raise DatasetError("damaged description of a scene", where=where, found=error) from error
    in_base = transform_points(inverse(_base(arrays)), points[None])
    commands = arrays["gripper_status"].reshape(-1)
    unmoved = np.logical_and.accumulate(commands == commands[0])
    pixels = {
        camera: project(in_camera_parent(episode.camera_parent(camera), in_base, tcp_in_base, arrays))
        for camera, project in projections.items()
    }
    for values in pixels.values():
        values[~unmoved] = np.nan
    return SceneObjects(steps, target_id, classes, pixels, in_base[0])


def calibration(
    episode: SourceEpisode, camera: str, arrays: Mapping[str, NDArray[Any]], stored: tuple[int, int], view: View
) -> dict[str, Any]:
    """Return the ``camera`` argument of `Unproject`.

    The pose of a world camera is relative to the first pose of the arm's base.
    """
    mount, parent = episode.camera_in_parent(camera), episode.camera_parent(camera)
    if parent == "world":
        mount = inverse(_base(arrays))[0] @ mount
    left, top, right, bottom = np.array(view.box()) / np.tile(view.image_size, 2)
    scale, intrinsic = np.array(view.size) / (right - left, bottom - top), episode.intrinsic(camera)
    focal, center = intrinsic[:2] / stored * scale, (intrinsic[2:] / stored - (left, top)) * scale
    return {"on_hand": parent == "ee", "mount": mount.tolist(), "intrinsic": [*focal.tolist(), *center.tolist()]}


def same_calibration(one: dict[str, Any], other: dict[str, Any], keys: Sequence[str] = tuple(_TOLERANCES)) -> bool:
    """Return whether two calibrations agree to 1 mm, 1 mrad and 0.01 pixels."""
    return all(np.allclose(one[key], other[key], rtol=0, atol=_TOLERANCES[key]) for key in keys)


def in_camera_parent(parent: Parent, points: Array, tcp_in_base: Array, arrays: Mapping[str, NDArray[Any]]) -> Array:
    """Transform points (T, N, 3) from the arm's base frame to the frame of a camera's parent."""
    if parent == "ee":
        return transform_points(inverse(tcp_in_base), points)
    return transform_points(_base(arrays), points) if parent == "world" else points


def _base(arrays: Mapping[str, NDArray[Any]]) -> Array:
    """Return the poses (T, 4, 4) of the arm's base in the world frame."""
    return from_xyzw(arrays["base_pos"].astype(np.float64), arrays["base_orn"].astype(np.float64))
