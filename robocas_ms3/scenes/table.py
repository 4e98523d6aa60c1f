"""Layouts of many envs as arrays: one file that is mapped into memory, so that a reset of any number is a gather.

A table holds S sets of objects (by the seed that drew them) with L layouts each (by their own seeds). It is made of a
bank (`bank.fill`, then `write_table`) and lies beside its layouts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.errors import LayoutError
from robocas_ms3.files import replacing
from robocas_ms3.scenes.layout import Array, Layout

TABLE = "table.npy"  # in the folder of a bank
_MADE_BY = "Make it again: robocas layouts build."
_AXES = ("objects_seed", (slice(None), 0)), ("seed", (0, slice(None)))  # both in rising order


@dataclass(frozen=True)
class LayoutBatch:
    """Layouts of E envs. K object slots; world frame, metres, quaternions wxyz.

    Attributes:
        object_poses: (E, K, 7) float32.
        robot_poses: (E, 7) of the robot's root.
        basket_poses: (E, 7).
        targets: (E,) slots.
        present: (E, K) bool.
    """

    object_poses: NDArray[np.float32]
    robot_poses: NDArray[np.float32]
    basket_poses: NDArray[np.float32]
    targets: NDArray[np.int64]
    present: NDArray[np.bool_]

    @classmethod
    def of(cls, layouts: Sequence[Layout]) -> LayoutBatch:
        """Stack layouts, one an env."""
        return cls(
            raw_poses(np.stack([layout.object_poses for layout in layouts])),
            raw_poses(np.stack([layout.robot_pose for layout in layouts])),
            raw_poses(np.stack([layout.basket_pose for layout in layouts])),
            np.array([layout.target for layout in layouts]),
            np.stack([layout.present for layout in layouts]),
        )


class LayoutTable:
    """Layouts from a mapped file.

    What an episode needs is taken from it; what is said of one, such as its objects' ids, is the bank's to tell.

    Args:
        path: of the file.

    Raises:
        LayoutError: it is damaged.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._rows: NDArray[np.void] = np.lib.format.open_memmap(path, mode="r")
            self._sets, self._seeds = (self._rows[name][place].copy() for name, place in _AXES)
        except (OSError, ValueError, IndexError, EOFError) as error:  # IndexError: no such fields
            raise LayoutError("no table of layouts", where=path, found=error, fix=_MADE_BY) from error

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Objects seed and seed of all layouts that it holds."""
        there = np.asarray(self._rows[self._rows["there"]])
        return [*zip(there["objects_seed"].tolist(), there["seed"].tolist(), strict=True)]

    def find(self, objects_seeds: NDArray[np.int64], seeds: NDArray[np.int64]) -> LayoutBatch | None:
        """Gather the layouts of E pairs of seeds, (E,) each; None where it lacks one of them."""
        sets, columns = np.searchsorted(self._sets, objects_seeds), np.searchsorted(self._seeds, seeds)
        if sets.max(initial=0) >= len(self._sets) or columns.max(initial=0) >= len(self._seeds):
            return None
        rows = np.asarray(self._rows[sets, columns])
        if not (rows["there"] & (rows["objects_seed"] == objects_seeds) & (rows["seed"] == seeds)).all():
            return None
        # a record's length is no multiple of a float's, which tensors can't be made of
        return LayoutBatch(
            np.ascontiguousarray(rows["object_poses"]),
            np.ascontiguousarray(rows["robot_pose"]),
            np.ascontiguousarray(rows["basket_pose"]),
            rows["target"].astype(np.int64),
            np.ascontiguousarray(rows["present"]),
        )


def write_table(path: Path, layouts: Mapping[tuple[int, int], Layout]) -> None:
    """Write layouts as a table.

    Args:
        path: of the file.
        layouts: by objects seed and seed; pairs of these seeds that are missing have no layout.
    """
    slots = len(next(iter(layouts.values())).object_ids)
    sets, seeds = (sorted({pair[side] for pair in layouts}) for side in (0, 1))
    rows = np.zeros((len(sets), len(seeds)), _record(slots))
    rows["objects_seed"], rows["seed"] = np.array(sets)[:, None], seeds
    batch = LayoutBatch.of(list(layouts.values()))
    place = [sets.index(pair[0]) for pair in layouts], [seeds.index(pair[1]) for pair in layouts]
    rows["there"][place] = True
    rows["object_poses"][place], rows["present"][place] = batch.object_poses, batch.present
    rows["robot_pose"][place], rows["basket_pose"][place] = batch.robot_poses, batch.basket_poses
    rows["target"][place] = batch.targets
    with replacing(path) as tmp, tmp.open("wb") as file:
        np.save(file, rows)


def _record(slots: int) -> np.dtype:
    return np.dtype(
        [
            ("objects_seed", "i8"),
            ("seed", "i8"),
            ("there", "?"),
            ("object_poses", "f4", (slots, 7)),
            ("robot_pose", "f4", 7),
            ("basket_pose", "f4", 7),
            ("target", "i2"),
            ("present", "?", (slots,)),
        ]
    )


def raw_poses(matrices: Array) -> NDArray[np.float32]:
    """(..., 4, 4) -> (..., 7): position, quaternion wxyz."""
    flat = matrices.reshape(-1, 4, 4)
    xyzw = Rotation.from_matrix(flat[:, :3, :3]).as_quat()
    poses = np.concatenate([flat[:, :3, 3], xyzw[:, [3, 0, 1, 2]]], axis=1).astype(np.float32)
    return poses.reshape(*matrices.shape[:-2], 7)
