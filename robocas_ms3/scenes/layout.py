"""The layout of a scene (poses and target at the start of an episode), and its ``.npz`` file."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import open_npz
from robocas_ms3.core.files import atomic_file

Array = NDArray[np.float64]

ObjectIds = tuple[str, ...]
"""Objects of a scene: one id of the object pack per slot."""

_FILE_KEYS = {"visible_fractions": "visible_shares"}  # keys of files where they differ from the fields' names
_ROTATION_ERROR = 1e-3  # tolerance of rotation matrices, for single precision
PARKING_HEIGHT = -5.0  # z in m of the plane on which the objects of unused slots are placed


@dataclass(frozen=True)
class Layout:
    """Poses of objects, robot and basket at the start of an episode, and the target.

    K object slots; world frame, m.

    Attributes:
        object_ids: K ids of the object pack, one per slot.
        object_poses: (K, 4, 4) poses of the objects at rest. Objects of unused slots are below the floor.
        robot_pose: (4, 4) pose of the robot's root on the floor.
        basket_pose: (4, 4) pose of the basket's frame; None if the scene has no basket.
        target: index of the target's slot.
        relation: relation that distinguishes the target from identical objects, such as ``nearest``; empty: none.
        present: (K,) bool, whether each slot is used; default: all. K is equal for all seeds of a configuration.
        visible_fractions: (K,) visible fraction (p_vis in the paper) of each object, seen from the selection camera;
            NaN: not computed.
    """

    object_ids: ObjectIds
    object_poses: Array
    robot_pose: Array
    basket_pose: Array | None
    target: int
    relation: str = ""
    present: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    visible_fractions: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if len(self.present) == 0:
            object.__setattr__(self, "present", np.ones(len(self.object_ids), dtype=bool))
        if len(self.visible_fractions) == 0:
            object.__setattr__(self, "visible_fractions", np.full(len(self.object_ids), np.nan))

    def check(self, names: Collection[str]) -> None:
        """Raise ValueError if the layout is invalid.

        Args:
            names: ids of all objects in the object pack.
        """
        count = len(self.object_ids)
        shapes = self.object_poses.shape, self.present.shape, self.visible_fractions.shape
        if shapes != ((count, 4, 4), (count,), (count,)):
            raise ValueError(f"expected poses, present and visible fractions of {count} objects, found shapes {shapes}")
        if unknown := sorted(set(self.object_ids) - set(names)):
            raise ValueError(f"expected only objects of the object pack, found {unknown}")
        fixtures = [self.robot_pose] if self.basket_pose is None else [self.robot_pose, self.basket_pose]
        if any(pose.shape != (4, 4) for pose in fixtures):
            raise ValueError(f"expected 4 x 4 poses of robot and basket, found {[pose.shape for pose in fixtures]}")
        if not 0 <= self.target < count:
            raise ValueError(f"expected a target slot from 0 to {count - 1}, found {self.target}")
        poses = np.concatenate([self.object_poses, fixtures])
        turns = poses[:, :3, :3]
        if not np.isfinite(poses).all():
            raise ValueError("a pose with NaN or infinite values")
        if np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max() > _ROTATION_ERROR:
            raise ValueError("a pose whose rotation matrix is not orthonormal")


LayoutSource = Callable[[int, int], Layout]
"""(objects seed, seed) -> layout."""


def write_layout(layout: Layout, path: Path) -> None:
    values = {_FILE_KEYS.get(f.name, f.name): getattr(layout, f.name) for f in fields(Layout)}
    arrays: dict[str, Any] = {
        name: np.zeros(0) if value is None else np.asarray(value) for name, value in values.items()
    }
    archive = BytesIO()  # on a full disk, closing a zip file would raise a second error
    np.savez(archive, **arrays)
    with atomic_file(path) as tmp:
        tmp.write_bytes(archive.getbuffer())


def read_layout(path: Path) -> Layout:
    """Read a layout file.

    Raises:
        ValueError, KeyError, TypeError, or one of `documents.DAMAGED_FILE_ERRORS`: the file is damaged.
    """
    with open_npz(path) as file:
        values = {f.name: file[_FILE_KEYS.get(f.name, f.name)] for f in fields(Layout)}
    return Layout(
        **{
            **values,
            "basket_pose": values["basket_pose"] if values["basket_pose"].size else None,
            "object_ids": tuple(values["object_ids"].tolist()),
            "target": int(values["target"]),
            "relation": str(values["relation"]),
        }
    )
