"""Read grasp labels of GraspNet-1Billion (``NNN_labels.npz``) and convert them to TCP poses.

For each point of the object, 300 views on a Fibonacci lattice, 12 in-plane angles and 4 depths, a label has the width
of the gripper, a collision flag, and the smallest friction coefficient with which the grasp holds.
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

from asset_tools.grasps import Grasps, sample_surface_points, select_diverse_grasps, to_local_frames
from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

VIEWS, ANGLES, DEPTHS = 300, 12, 4
MAX_FRICTION, MAX_WIDTH = 0.3, 0.08  # limits of RoboCAS-v0; m
ROUNDING = 1e-3  # labels are in single or half precision, in steps of 0.1
SLICE_BYTES = 24e6  # bytes of labels per slice
CANDIDATES = 20_000  # number of checked labels; a file has up to a million good labels
MOST_GRASPS = 800  # maximum number, spread over directions and positions
POINTS, CHUNK = 3000, 128  # surface points for collision checks; grasps per batch

SHAPES = {
    "points": (3,),
    "offsets": (VIEWS, ANGLES, DEPTHS, 3),
    "scores": (VIEWS, ANGLES, DEPTHS),
    "collision": (VIEWS, ANGLES, DEPTHS),
}


@dataclass(frozen=True)
class GraspLabels:
    """N grasp labels in the frame of the model.

    Attributes:
        points: (N, 3) points on the object, m.
        views: (N,) indices of the views, see `make_view_directions`.
        angles: (N,) rotations of the gripper about the approach direction, rad.
        depths: (N,) distances of the finger tips beyond the point, m.
        widths: (N,) distances of the fingers, m.
        frictions: (N,) smallest friction coefficients for force closure.
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
    """An open array of a label file.

    Attributes:
        file: stream of the values.
        count: length of the first axis.
        dtype: type of the values.
    """

    file: IO[bytes]
    count: int
    dtype: np.dtype

    def read_rows(self, name: str, rows: int) -> NDArray:
        """Read the next ``rows`` rows of the array; ``name`` is the name of the array."""
        shape = (rows, *SHAPES[name])
        size = int(np.prod(shape)) * self.dtype.itemsize
        data = self.file.read(size)
        if len(data) < size:
            raise EOFError(f"{name} is truncated")
        return np.frombuffer(data, self.dtype).reshape(shape)

    def finish(self) -> None:
        """Read the end of the stream, so that zipfile verifies the checksum."""
        self.file.read(1)


def load_label_grasps(path: Path, closed: trimesh.Trimesh) -> tuple[Grasps, int]:
    """Load labelled grasps that the open gripper reaches on a straight path, spread over the object.

    Args:
        path: path of ``NNN_labels.npz``.
        closed: watertight mesh of the object in the model's frame, m.

    Returns:
        The grasps, and the number of good labels (at most 20 000) from which they were selected.

    Raises:
        AssetError: the file is damaged or has another format.
    """
    rng = np.random.default_rng(0)
    labels = read_labels(path, rng)
    poses = to_tcp_poses(labels)
    points = sample_surface_points(closed, POINTS, rng)[0]
    clear = np.flatnonzero(_clear(poses, points))
    poses, frictions = poses[clear], labels.frictions[clear]
    to_center = np.asarray(closed.center_mass) - poses[:, :3, 3]
    # a centre of mass far from the approach line rotates the object in the pads
    lever = np.linalg.norm(np.cross(to_center, poses[:, :3, 2]), axis=1)
    scores = -2.0 * frictions - lever / 0.15 - np.linalg.norm(to_center, axis=1) / 0.3
    chosen = select_diverse_grasps(poses, scores, MOST_GRASPS)
    return Grasps(poses[chosen], labels.widths[clear][chosen], frictions[chosen]), len(labels)


def read_label_checksums(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Return name, size and CRC of each array in a label file, without reading the arrays.

    A file that is not a zip archive gives its own name and size. The error is raised later by `read_labels`.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return tuple((member.filename, member.file_size, member.CRC) for member in archive.infolist())
    except zipfile.BadZipFile:
        return ((path.name, path.stat().st_size, 0),)


def read_labels(path: Path, rng: np.random.Generator) -> GraspLabels:
    """Read the good labels of a file: friction 0 < f <= 0.3, at most 0.08 m wide, not in collision.

    RoboCAS-v0 also accepts the friction 0. This value is not a friction coefficient: valid labels start at 0.1, and
    the tools of the dataset skip 0 and -1, where -1 means that the grasp never holds.

    Args:
        path: path of ``NNN_labels.npz``.
        rng: random generator, which selects labels uniformly if there are more than 20 000 good labels.

    Returns:
        The labels in the order of the file.

    Raises:
        AssetError: the file is missing, damaged or has another format.
    """
    kept = np.empty((0, 8))  # random number, position in the file, point, view, angle, depth, width, friction
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
        raise _damaged(path, "finite numbers", "NaN or infinite labels")
    _, _, point, view, angles, depths, widths, frictions = kept.T
    return GraspLabels(points[point.astype(int)], view.astype(np.int64), angles, depths, widths, frictions)


def make_view_directions() -> Array:
    """Return the 300 view directions of the dataset (300, 3): unit vectors from the object to the gripper."""
    i = np.arange(VIEWS)
    z = (2 * i + 1) / VIEWS - 1
    around = 2 * np.pi * i * (np.sqrt(5) - 1) / 2
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(around), radius * np.sin(around), z])


def to_tcp_poses(labels: GraspLabels) -> Array:
    """Convert labels to poses of the TCP (N, 4, 4) in the frame of the model, m.

    In the TCP frame, z is the approach direction, y the closing direction, and the origin is between the finger tips.
    In the gripper frame of GraspNet-1Billion, x is the approach direction. Its closing axis y is horizontal at angle 0,
    and the angle is a rotation about x. The finger tips are ``depth`` beyond the point of the label.
    """
    approach = -make_view_directions()[labels.views]
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
    """Return whether the open gripper reaches each pose (N,) straight without touching the object.

    Args:
        poses: (N, 4, 4) poses of the TCP.
        points: (P, 3) points on the object.
    """
    free = np.ones(len(poses), dtype=bool)
    for start in range(0, len(poses), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = to_local_frames(points, poses[chunk, :3, :3], poses[chunk, :3, 3])
        x, y = np.abs(x), np.abs(y)
        for low, high in GRIPPER_BOXES:
            # the box sweeps all points behind its front during the approach
            free[chunk] &= ~((x <= high[0]) & (y >= low[1]) & (y <= high[1]) & (z <= high[2])).any(axis=1)
    return free


def _read_points(path: Path) -> Array:
    with _opened(path) as members:
        points = members["points"].read_rows("points", members["points"].count).astype(np.float64)
        members["points"].finish()
        if not np.isfinite(points).all():
            raise _damaged(path, "finite points", "NaN or infinite points")
        return points


def _slices(path: Path, count: int) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    """Yield the label arrays in batches of K points.

    Args:
        path: path of the label file.
        count: number of points in the file.

    Yields:
        ``offsets`` (K, 300, 12, 4, 3), ``scores`` (K, 300, 12, 4) and ``collision`` (K, 300, 12, 4).
    """
    names = ("offsets", "scores", "collision")
    with _opened(path) as members:
        size = sum(int(np.prod(SHAPES[name])) * members[name].dtype.itemsize for name in names)
        step = max(1, int(SLICE_BYTES / size))
        for start in range(0, count, step):
            a, b, c = (members[name].read_rows(name, min(step, count - start)) for name in names)
            yield a, b, c
        for name in names:
            members[name].finish()


@contextmanager
def _opened(path: Path) -> Iterator[dict[str, _Member]]:
    """Open the arrays of a label file and check their shapes.

    Each stream is at the first value of its array.
    """
    try:
        with ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(path))
            found = {name.removesuffix(".npy") for name in archive.namelist()}
            if not set(SHAPES) <= found:
                expected, names = f"the arrays {', '.join(SHAPES)}", ", ".join(sorted(found)) or "no array"
                raise _damaged(path, expected, names)
            members = {name: _member(path, name, stack.enter_context(archive.open(f"{name}.npy"))) for name in SHAPES}
            counts = {member.count for member in members.values()}
            if len(counts) > 1 or 0 in counts:
                numbers = f"the numbers of points {', '.join(map(str, sorted(counts)))}"
                raise _damaged(path, "the same number of points, at least 1, in each array", numbers)
            yield members
    except FileNotFoundError as error:
        fix = "Download the grasp labels of GraspNet-1Billion."
        raise AssetError("missing file of GraspNet-1Billion's grasp labels", where=path, fix=fix) from error
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, OSError, NotImplementedError) as error:
        raise _damaged(path, "an npz archive", str(error) or type(error).__name__) from error


def _member(path: Path, name: str, file: IO[bytes]) -> _Member:
    read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
    shape, columns_first, dtype = read(file)
    kind = "b" if name == "collision" else "f"
    if shape[1:] != SHAPES[name] or dtype.kind != kind or columns_first:
        expected = f"{name} (P, {', '.join(map(str, SHAPES[name]))}) of {'bool' if kind == 'b' else 'floats'}"
        raise _damaged(path, expected, f"shape {shape} of {dtype}")
    return _Member(file, shape[0], dtype)


def _damaged(path: Path, expected: str, found: str) -> AssetError:
    return AssetError(
        "the grasp labels are damaged", where=path, expected=expected, found=found, fix="Download the file again."
    )
