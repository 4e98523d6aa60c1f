"""GraspNet-1Billion's grasp labels: ``NNN_labels.npz``, hundreds of MB each, read in slices and put in our terms.

For each point of the object, 300 views on a Fibonacci lattice, 12 in-plane angles and 4 depths, a label says how wide
the gripper opens, whether it hits the object, and from which friction coefficient on the grasp holds.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import trimesh
from numpy.lib import format as npy
from numpy.typing import NDArray

from asset_tools.grasps import Grasps, local_points, select_spread, surface_samples
from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

VIEWS, ANGLES, DEPTHS = 300, 12, 4
MAX_FRICTION, MAX_WIDTH = 0.3, 0.08  # what RoboCAS keeps; m
ROUNDING = 1e-3  # labels come in single or half precision, in steps of 0.1
SLICE_BYTES = 24e6  # of labels read at a time
CANDIDATES = 20_000  # labels that are looked at closely; a file has up to a million good ones
MOST_GRASPS = 800  # of those that fit, spread over directions and places
POINTS, CHUNK = 3000, 128  # of the surface that the gripper must not hit; grasps tested at a time

SHAPES = {
    "points": (3,),
    "offsets": (VIEWS, ANGLES, DEPTHS, 3),
    "scores": (VIEWS, ANGLES, DEPTHS),
    "collision": (VIEWS, ANGLES, DEPTHS),
}


@dataclass(frozen=True)
class Labels:
    """Labels (N,) in the model's frame.

    Attributes:
        points: (N, 3) the gripper is at, m.
        views: numbers of the views.
        angles: in-plane, rad.
        depths: that the finger tips go beyond the point, m.
        widths: of the opening, m.
        frictions: lowest friction coefficient that closes the grasp.
    """

    points: Array
    views: NDArray[np.int64]
    angles: Array
    depths: Array
    widths: Array
    frictions: Array

    def __len__(self) -> int:
        return len(self.views)


@dataclass(frozen=True)
class _Member:
    """An array of a label file: read up to somewhere, its length, its type."""

    file: IO[bytes]
    count: int
    dtype: np.dtype

    def take(self, name: str, rows: int) -> NDArray:
        """The next rows."""
        shape = (rows, *SHAPES[name])
        size = int(np.prod(shape)) * self.dtype.itemsize
        data = self.file.read(size)
        if len(data) < size:
            raise EOFError(f"{name} is cut short")
        return np.frombuffer(data, self.dtype).reshape(shape)

    def end(self) -> None:
        """Have the checksum compared, which happens at the end of the file."""
        self.file.read(1)


def label_grasps(path: Path, closed: trimesh.Trimesh) -> tuple[Grasps, int]:
    """The labelled grasps that our open gripper reaches on a straight way in, spread over directions and places.

    Args:
        path: ``NNN_labels.npz``.
        closed: watertight mesh of the object in the model's frame, m.

    Returns:
        The grasps, and the number of good labels (20 000 at most) that they were chosen from.

    Raises:
        AssetError: the file is damaged or not of this format.
    """
    rng = np.random.default_rng(0)
    labels = read_labels(path, rng)
    poses = tcp_poses(labels)
    points = surface_samples(closed, POINTS, rng)[0]
    clear = np.flatnonzero(_clear(poses, points))
    poses, frictions = poses[clear], labels.frictions[clear]
    to_center = np.asarray(closed.center_mass) - poses[:, :3, 3]
    # Weight far off the approach line twists the object in the pads; along that line it does little harm.
    lever = np.linalg.norm(np.cross(to_center, poses[:, :3, 2]), axis=1)
    scores = -2.0 * frictions - lever / 0.15 - np.linalg.norm(to_center, axis=1) / 0.3
    chosen = select_spread(poses, scores, MOST_GRASPS)
    return Grasps(poses[chosen], labels.widths[clear][chosen], frictions[chosen]), len(labels)


def label_checksums(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, sizes and CRCs of the arrays in a label file, from its directory: what it holds, without reading it all.

    Of a file without a directory, just its size; `read_labels` says what is wrong with it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return tuple((member.filename, member.file_size, member.CRC) for member in archive.infolist())
    except zipfile.BadZipFile:
        return ((path.name, path.stat().st_size, 0),)


def read_labels(path: Path, rng: np.random.Generator) -> Labels:
    """Read the labels of good grasps: friction 0 < f <= 0.3, at most 0.08 m wide, not in collision.

    RoboCAS lets 0 pass as well, but that isn't a friction coefficient: labels of grasps that hold start at 0.1, and
    the dataset's own tools skip 0 along with -1, which stands for "never holds".

    Args:
        path: ``NNN_labels.npz``.
        rng: chooses evenly among the good ones where there are more than 20 000.

    Returns:
        In the order of the file.

    Raises:
        AssetError: the file is missing, damaged or not of this format.
    """
    kept = np.empty((0, 8))  # draw, place in the file, number of the point, of the view, angle, depth, width, friction
    place = start = 0
    points = _read_points(path)
    for offsets, scores, collision in _slices(path, len(points)):
        angles, depths, widths = np.moveaxis(offsets, -1, 0)
        good = (scores > 0) & (scores <= MAX_FRICTION + ROUNDING) & (widths <= MAX_WIDTH + 1e-6) & ~collision
        where = np.nonzero(good)
        point, view = start + where[0], where[1]
        count = len(point)
        columns = [rng.random(count), place + np.arange(count), point, view]
        columns += [values[where].astype(np.float64) for values in (angles, depths, widths, scores)]
        kept = np.concatenate([kept, np.column_stack(columns)])
        if len(kept) > CANDIDATES:
            kept = kept[np.argpartition(kept[:, 0], CANDIDATES)[:CANDIDATES]]
        place += count
        start += len(offsets)
    kept = kept[np.argsort(kept[:, 1])]
    if not np.isfinite(kept).all():
        raise _damaged(path, "finite numbers", "labels that are not")
    _, _, point, view, angles, depths, widths, frictions = kept.T
    return Labels(points[point.astype(int)], view.astype(np.int64), angles, depths, widths, frictions)


def view_directions() -> Array:
    """The 300 views (300, 3): unit vectors from the object outwards; the gripper approaches against them."""
    i = np.arange(VIEWS)
    z = (2 * i + 1) / VIEWS - 1
    around = 2 * np.pi * i * (np.sqrt(5) - 1) / 2
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(around), radius * np.sin(around), z])


def tcp_poses(labels: Labels) -> Array:
    """TCP poses (N, 4, 4) in the model's frame: z approach, y closing, origin midway between the finger tips.

    There the gripper's frame has x along the approach and, at angle 0, its closing axis y level; the angle turns it
    about the approach. Finger tips reach ``depth`` beyond the point.
    """
    approach = -view_directions()[labels.views]
    level = np.column_stack([-approach[:, 1], approach[:, 0], np.zeros(len(labels))])  # no view is vertical
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    cos, sin = np.cos(labels.angles)[:, None], np.sin(labels.angles)[:, None]
    closing = cos * level + sin * np.cross(approach, level)
    poses = np.tile(np.eye(4), (len(labels), 1, 1))
    poses[:, :3, 0] = np.cross(closing, approach)
    poses[:, :3, 1] = closing
    poses[:, :3, 2] = approach
    poses[:, :3, 3] = labels.points + labels.depths[:, None] * approach
    return poses


def _clear(poses: Array, points: Array) -> NDArray[np.bool_]:
    """Whether the open gripper (N,), coming straight in, hits none of the points (P, 3)."""
    free = np.ones(len(poses), dtype=bool)
    for start in range(0, len(poses), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = local_points(points, poses[chunk, :3, :3], poses[chunk, :3, 3])
        x, y = np.abs(x), np.abs(y)
        for low, high in GRIPPER_BOXES:
            # whatever lies behind the front of a box is hit on the way in
            free[chunk] &= ~((x <= high[0]) & (y >= low[1]) & (y <= high[1]) & (z <= high[2])).any(axis=1)
    return free


def _read_points(path: Path) -> Array:
    with _opened(path) as members:
        points = members["points"].take("points", members["points"].count).astype(np.float64)
        members["points"].end()
        if not np.isfinite(points).all():
            raise _damaged(path, "finite points", "others")
        return points


def _slices(path: Path, count: int) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    """Offsets (K, 300, 12, 4, 3), scores and collision (K, 300, 12, 4) of some points at a time."""
    names = ("offsets", "scores", "collision")
    with _opened(path) as members:
        size = sum(int(np.prod(SHAPES[name])) * members[name].dtype.itemsize for name in names)
        step = max(1, int(SLICE_BYTES / size))
        for start in range(0, count, step):
            a, b, c = (members[name].take(name, min(step, count - start)) for name in names)
            yield a, b, c
        for name in names:
            members[name].end()


@contextmanager
def _opened(path: Path) -> Iterator[dict[str, _Member]]:
    """The arrays of a label file, checked, each open at its first value."""
    try:
        with ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(path))
            found = {name.removesuffix(".npy") for name in archive.namelist()}
            if not set(SHAPES) <= found:
                raise _damaged(path, ", ".join(SHAPES), ", ".join(sorted(found)) or "nothing")
            members = {name: _member(path, name, stack.enter_context(archive.open(f"{name}.npy"))) for name in SHAPES}
            counts = {member.count for member in members.values()}
            if len(counts) > 1 or 0 in counts:
                raise _damaged(path, "as many points in each array", ", ".join(map(str, sorted(counts))))
            yield members
    except FileNotFoundError as error:
        raise AssetError("there is no such label file", where=path) from error
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, OSError, NotImplementedError) as error:
        raise _damaged(path, "an npz archive", str(error) or type(error).__name__) from error


def _member(path: Path, name: str, file: IO[bytes]) -> _Member:
    read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
    shape, columns_first, dtype = read(file)
    kind = "b" if name == "collision" else "f"
    if shape[1:] != SHAPES[name] or dtype.kind != kind or columns_first:
        expected = f"{name} (P, {', '.join(map(str, SHAPES[name]))}) of {'bool' if kind == 'b' else 'floats'}"
        raise _damaged(path, expected, f"{shape} of {dtype}")
    return _Member(file, shape[0], dtype)


def _damaged(path: Path, expected: str, found: str) -> AssetError:
    return AssetError(
        "the grasp labels are damaged", where=path, expected=expected, found=found, fix="Download the file again."
    )
