"""HDF5 files of trajectories: written without harm by a full disk, and read only from within the file itself.

HDF5 ends the process where it can't write what it holds, so files are made in memory or on reserved space. HDF5 lets a
file name others: by links, as the place of an array's bytes, as pieces of an array. A recording is somebody's data and
chooses no paths: what does is refused, and nothing of it is read.
"""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DocumentError, check_regular
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.recordings.entries import reason

BODIES = ("actors", "articulations")
"""Kinds of states whose rows are a position, a wxyz quaternion and more."""

_UNIT = 0.05  # a simulation keeps the length of quaternions better
_HARD: int = getattr(h5py, "h5l").TYPE_HARD  # noqa: B009  (its stubs lack it)
_LIMIT = 2**30  # bytes of an episode's states: ten thousand steps of forty bodies are 20 MB
_DEEP = 4  # groups in groups that states may have


def write_whole(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Make a file in memory and write it at once.

    Raises:
        OSError: it can't be written.
    """
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        fill(file)
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


@contextmanager
def reserved(path: Path, size: int) -> Iterator[h5py.File]:
    """Open a new file of which so many bytes have their place on the disk; what is not needed is given back.

    Raises:
        OSError: there is no room for them.
    """
    write_whole(path, lambda file: None)
    with path.open("r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, max(size, 1))
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # a file system that reserves nothing
                raise
    with h5py.File(path, "r+") as file:
        yield file


@contextmanager
def readable(where: object, what: str = "this episode is damaged") -> Iterator[None]:
    """Read of an HDF5 file."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, AttributeError, ValueError, TypeError, MemoryError) as error:
        raise DatasetError(what, where=where, found=reason(error)) from error


def open_trajectory(path: Path) -> h5py.File:
    """Open an HDF5 trajectory for reading."""
    try:
        check_regular(path)
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        raise DatasetError("no such trajectory file", where=path) from error
    except (OSError, DocumentError) as error:
        raise DatasetError(
            "can't read this HDF5 file: it is cut off, damaged, or no HDF5",
            where=path,
            found=reason(error),
            fix="Generate it again.",
        ) from error


def open_episode(file: h5py.File, number: int) -> h5py.Group:
    """Find an episode of an open trajectory, and see that no link in it leads elsewhere."""
    name = f"traj_{number}"
    where = f"{file.filename}, {name}"
    astray: list[bytes] = []

    def look(place: bytes, link: Any) -> bool | None:
        return None if link.type == _HARD else astray.append(place) or True

    with readable(where):
        links: Any = file.id.links
        if not links.exists(name.encode()):
            raise KeyError(name)
        group: Any = file[name] if links.get_info(name.encode()).type == _HARD else None
        if group is None:
            raise _leads_out(where, "a link")
        if group.id.links.visit(look, info=True):  # comes to each group once, in a ring too
            raise _leads_out(f"{where}/{astray[0].decode(errors='replace')}", "a link")
    return group


def copy_episode(source: h5py.File, number: int, target: h5py.File, new_number: int) -> None:
    """Copy an episode to another trajectory."""
    group = open_episode(source, number)
    with readable(f"{source.filename}, traj_{number}"):
        group.visititems(lambda _, item: _check_own(item) if isinstance(item, h5py.Dataset) else None)
        source.copy(group, target, name=f"traj_{new_number}")


def read_actions(episode: h5py.Group) -> NDArray[np.float32]:
    """Actions (S, A) of an episode."""
    where = _where(episode)
    with readable(where):
        actions = np.asarray(_read(_found(episode["actions"], 0)), np.float32)
    if actions.ndim != 2 or len(actions) == 0:
        raise DatasetError("this episode has no actions", where=where)
    check_finite(actions, f"{where}, actions")
    return actions


def check_finite(rows: NDArray[Any], where: object) -> None:
    """See that numbers are numbers: a policy can't learn from what is none, and a simulation keeps it.

    Args:
        rows: (S, ...), a step each.
    """
    finite = np.isfinite(rows)
    if not finite.all():
        step = int(np.argwhere(~finite)[0, 0])
        place = f"{where}, row {step}"
        raise DatasetError("NaN or infinity", where=place, expected="finite numbers", fix="Record it again.")


def read_states(episode: h5py.Group) -> dict[str, Any]:
    """All of the states: by kind and name, the steps first; what is kept beside bodies may be nested deeper."""
    with readable(_where(episode)):
        return _read(_found(episode["env_states"], _DEEP))


def read_bodies(episode: h5py.Group, *, only: str | None = None) -> dict[str, dict[str, NDArray[np.float32]]]:
    """States of bodies: by kind and name, (S + 1, D) each.

    Args:
        only: name of the one to read; default: all.
    """
    with readable(_where(episode)):
        states: Any = episode["env_states"]
        kinds = {kind: states[kind] for kind in BODIES if kind in states}
        if only is not None:
            kinds = {kind: {only: of[only]} if only in of else {} for kind, of in kinds.items()}
        bodies = _read({kind: {name: _found(of[name], 0) for name in of} for kind, of in kinds.items()})
    check_bodies(bodies, _where(episode))
    return {
        kind: {name: rows.astype(np.float32, copy=False) for name, rows in of.items()} for kind, of in bodies.items()
    }


def check_bodies(states: dict[str, Any], where: object) -> None:
    """See that the states of bodies are finite numbers, with orientations.

    Args:
        states: of `read_states`.
    """
    for kind in BODIES:
        if not isinstance(bodies := states.get(kind, {}), dict):
            raise DatasetError("this episode is damaged", where=f"{where}, {kind}", expected="a group of bodies")
        for name, rows in bodies.items():
            place = f"{where}, {kind}/{name}"
            if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] < 7 or rows.dtype.kind not in "fiu":
                raise DatasetError("this episode is damaged", where=place, expected="rows of numbers")
            check_finite(rows, place)
            length = np.linalg.norm(rows[:, 3:7].astype(np.float64), axis=1)
            wrong = np.flatnonzero(abs(length - 1) > _UNIT)
            if len(wrong):
                row, found = wrong[0], f"{length[wrong[0]]:g}"
                expected = "a quaternion of length 1"
                raise DatasetError("no orientation", where=f"{place}, row {row}", expected=expected, found=found)


def _found(node: Any, deep: int) -> Any:
    """Nested groups as dicts of their arrays, which are yet to be read."""
    if isinstance(node, h5py.Dataset):
        _check_own(node)
        return node
    if not deep:
        raise ValueError("groups in groups in groups")
    return {name: _found(inner, deep - 1) for name, inner in node.items()}


def _read(found: Any) -> Any:
    if (size := _size(found)) > _LIMIT:  # a few compressed bytes can say they are terabytes
        raise ValueError(f"{size >> 20} MB of numbers, more than {_LIMIT >> 20}")
    return _values(found)


def _size(found: Any) -> int:
    if isinstance(found, dict):
        return sum(map(_size, found.values()))
    return math.prod(found.shape) * found.dtype.itemsize


def _values(found: Any) -> Any:
    return {name: _values(inner) for name, inner in found.items()} if isinstance(found, dict) else found[()]


def _check_own(array: h5py.Dataset) -> None:
    if array.external or array.is_virtual:
        raise _leads_out(f"{array.file.filename}, {str(array.name).strip('/')}", "one whose numbers are in other files")


def _where(episode: h5py.Group) -> str:
    return f"{episode.file.filename}, {str(episode.name).strip('/')}"


def _leads_out(where: str, found: str) -> DatasetError:
    what = "a recording can't choose files"
    return DatasetError(what, where=where, expected="arrays of its own", found=found, fix="Record it again.")
