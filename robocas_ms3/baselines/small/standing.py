"""Where the objects of a scene are seen as long as they stand where the layout put them.

That is until the gripper is told something else: the scripted policy comes to what it grasps on a way that is free.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.small.config import View
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import Array, from_xyzw, inverse, transform
from robocas_ms3.datasets.schema import SCENE_FILE
from robocas_ms3.datasets.sources.protocol import SourceEpisode
from robocas_ms3.robots.cameras import Parent

_ALIKE = {"mount": 1e-3, "intrinsic": 1e-2}


@dataclass(frozen=True)
class Standing:
    """Objects of an episode.

    Attributes:
        steps: of it.
        target: kind (asset) of the one that is meant; empty: not known.
        kinds: of each of N objects.
        places: (T, N, 2) in pixels of the view of each camera; NaN: behind it, or not known any more.
        points: (N, 3) where they stand in the arm's base, m.
    """

    steps: int
    target: str = ""
    kinds: list[str] = field(default_factory=list)
    places: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    points: NDArray[np.floating] = field(default_factory=lambda: np.zeros((0, 3)))


def standing(
    episode: SourceEpisode,
    arrays: Mapping[str, NDArray[Any]],
    tcp_in_base: Array,
    looks: Mapping[str, Callable[[Array], NDArray[np.float32]]],
) -> Standing:
    """Where an episode's objects are seen.

    Nothing is known of them where the scene does not tell, or another policy acted before.

    Args:
        episode: with its scene.
        arrays: its ``base_pos``, ``base_orn`` and ``gripper_status``.
        tcp_in_base: (T, 4, 4).
        looks: by camera, (T, N, 3) in its parent to (T, N, 2) in pixels.

    Raises:
        DatasetError: what is said of the scene is damaged.
    """
    steps = len(tcp_in_base)
    try:
        layout, target = episode.layout, episode.scene.get("target") or {}
        meant, known = str(target.get("asset_id") or ""), layout.get("poses")
        if not known or "takeover" in (episode.scene.get("recorded") or {}):  # who acted before has moved them
            nothing = np.full((steps, 0, 2), np.nan, np.float32)
            return Standing(steps, meant, places=dict.fromkeys(looks, nothing))
        there = np.array(layout.get("present") or [True] * len(known), bool)
        points = np.array(known, np.float64).reshape(-1, 7)[there, :3]
        kinds = [name for name, present in zip(layout["object_ids"], there, strict=True) if present]
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        where = f"{episode.where}/{SCENE_FILE}"
        raise DatasetError("this description of a scene is damaged", where=where, found=error) from error
    in_base = transform(inverse(_base(arrays)), points[None])
    opened = arrays["gripper_status"].reshape(-1)
    still = np.logical_and.accumulate(opened == opened[0])
    places = {
        camera: look(seen_from(episode.camera_parent(camera), in_base, tcp_in_base, arrays))
        for camera, look in looks.items()
    }
    for seen in places.values():
        seen[~still] = np.nan
    return Standing(steps, meant, kinds, places, in_base[0])


def calibration(
    episode: SourceEpisode, camera: str, arrays: Mapping[str, NDArray[Any]], stored: tuple[int, int], view: View
) -> dict[str, Any]:
    """How a camera looks, see `lifting.Lift`; of one that is fixed in the world where the arm's base stands first."""
    mount, parent = episode.camera_in_parent(camera), episode.camera_parent(camera)
    if parent == "world":
        mount = inverse(_base(arrays))[0] @ mount
    left, top, right, bottom = np.array(view.box()) / np.tile(view.rendered, 2)
    scale, intrinsic = np.array(view.size) / (right - left, bottom - top), episode.intrinsic(camera)
    focal, middle = intrinsic[:2] / stored * scale, (intrinsic[2:] / stored - (left, top)) * scale
    return {"on_hand": parent == "ee", "mount": mount.tolist(), "intrinsic": [*focal.tolist(), *middle.tolist()]}


def looks_alike(one: dict[str, Any], other: dict[str, Any], keys: Sequence[str] = tuple(_ALIKE)) -> bool:
    """Whether calibrations are the same, to a mm, a mrad and a hundredth of a pixel."""
    return all(np.allclose(one[key], other[key], rtol=0, atol=_ALIKE[key]) for key in keys)


def seen_from(parent: Parent, points: Array, tcp_in_base: Array, arrays: Mapping[str, NDArray[Any]]) -> Array:
    """(T, N, 3) points in the arm's base, in the frame that a camera is fixed to; ``tcp_in_base`` is (T, 4, 4)."""
    if parent == "ee":
        return transform(inverse(tcp_in_base), points)
    return transform(_base(arrays), points) if parent == "world" else points


def _base(arrays: Mapping[str, NDArray[Any]]) -> Array:
    """(T, 4, 4) the arm's base in the world."""
    return from_xyzw(arrays["base_pos"].astype(np.float64), arrays["base_orn"].astype(np.float64))
