"""HDF5 files of trajectories: written without harm by a full disk, merged, and read only from within the file itself.

HDF5 ends the process where it can't write what it holds, so files are made in memory or on reserved space. HDF5 lets a
file name others: by links, as the place of an array's bytes, as pieces of an array. A recording is somebody's data and
chooses no paths: such files are refused, and nothing of it is read.
"""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DocumentError, check_regular
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_file, write_json
from robocas_ms3.core.text import one_line
from robocas_ms3.demos.recordings.trajectory_json import one_seed, read_json

BODIES = ("actors", "articulations")
"""Kinds of states whose rows are a position, a wxyz quaternion and more."""

_UNIT = 0.05  # a simulation keeps the length of quaternions better
_HARD: int = getattr(h5py, "h5l").TYPE_HARD  # noqa: B009  (its stubs lack it)
_LIMIT = 2**30  # bytes of an episode's states: ten thousand steps of forty bodies are 20 MB
_DEEP = 4  # groups in groups that states may have
_MARGIN = 4096  # bytes an episode may need in a file of many beyond those of its own


def write_whole(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Make a file in memory and write it at once; raises OSError if it can't be written."""
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        fill(file)
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


@contextmanager
def reserved(path: Path, size: int) -> Iterator[h5py.File]:
    """Open a new file with ``size`` bytes reserved on the disk; raises OSError if there is no room."""
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
    """Turn whatever h5py raises while a file is read into a ``DatasetError``."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, AttributeError, ValueError, TypeError, MemoryError) as error:
        raise DatasetError(what, where=where, found=one_line(error)) from error


def open_trajectory(path: Path) -> h5py.File:
    try:
        check_regular(path)
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        raise DatasetError("no such trajectory file", where=path) from error
    except (OSError, DocumentError) as error:
        raise DatasetError(
            "can't read this HDF5 file: it is cut off, damaged, or no HDF5",
            where=path,
            found=one_line(error),
            fix="Generate it again.",
        ) from error


def open_episode(file: h5py.File, number: int) -> h5py.Group:
    """Return an episode of an open trajectory; raise ``DatasetError`` where a link in it leads elsewhere."""
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
    group = open_episode(source, number)
    with readable(f"{source.filename}, traj_{number}"):
        group.visititems(lambda _, item: _check_own(item) if isinstance(item, h5py.Dataset) else None)
        source.copy(group, target, name=f"traj_{new_number}")


def read_actions(episode: h5py.Group) -> NDArray[np.float32]:
    where = _where(episode)
    with readable(where):
        actions = np.asarray(_read(_found(episode["actions"], 0)), np.float32)
    if actions.ndim != 2 or len(actions) == 0:
        raise DatasetError("this episode has no actions", where=where)
    _check_finite(actions, f"{where}, actions")
    return actions


def read_steps(
    episode: h5py.Group, *, body: str | None = None, extras: bool = False
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Read actions (S, A) and states (S + 1, ...) of an episode by kind and name, and check that they are finite.

    States of all bodies are read, or those of one body, or with ``extras`` all others too, as of controllers.
    """
    where, actions = _where(episode), read_actions(episode)
    with readable(where):
        found: Any = episode["env_states"]
        if not extras:
            kinds = {kind: found[kind] for kind in BODIES if kind in found}
            found = {
                kind: {name: _found(of[name], 0) for name in of if body in (None, name)} for kind, of in kinds.items()
            }
        states = _read(_found(found, _DEEP) if extras else found)
    for name, rows in named_arrays(states):
        place, kind = f"{where}, {name}", name.split("/")[0]
        if rows.dtype.kind not in "fbiu" or rows.shape[:1] != (len(actions) + 1,):
            expected = f"{len(actions) + 1} rows of numbers, one more than actions"
            found = f"{rows.dtype} of shape {rows.shape}"
            raise DatasetError("this episode is damaged", where=place, expected=expected, found=found)
        _check_finite(rows, place)
        if kind in BODIES:
            _check_orientations(rows, name, place)
    return actions, states


def named_arrays(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the arrays in nested dicts, each with the path that leads to it."""
    if not isinstance(node, dict):
        yield name, node
        return
    for key, inner in node.items():
        yield from named_arrays(inner, f"{name}/{key}" if name else key)


def _check_finite(rows: NDArray[Any], where: str) -> None:
    finite = np.isfinite(rows)
    if not finite.all():
        place = f"{where}, row {int(np.argwhere(~finite)[0, 0])}"
        raise DatasetError("NaN or infinity", where=place, expected="finite numbers", fix="Record it again.")


def _check_orientations(rows: NDArray[Any], name: str, where: str) -> None:
    if name.count("/") != 1 or rows.ndim != 2 or rows.shape[1] < 7:
        raise DatasetError("this episode is damaged", where=where, expected="rows with a pose", found=rows.shape)
    length = np.linalg.norm(rows[:, 3:7].astype(np.float64), axis=1)
    wrong = np.flatnonzero(abs(length - 1) > _UNIT)
    if len(wrong):
        place, found = f"{where}, row {wrong[0]}", f"{length[wrong[0]]:g}"
        raise DatasetError("no orientation", where=place, expected="a quaternion of length 1", found=found)


def _found(node: Any, deep: int) -> Any:
    """Return nested groups as dicts of their arrays, not read yet."""
    if isinstance(node, h5py.Dataset):
        _check_own(node)
        return node
    if not deep:
        raise ValueError("groups in groups in groups")
    # not node.items(): it holds the lock of h5py for as long as the traceback of an error in here lives
    return {name: _found(node[name], deep - 1) for name in node}


def _read(found: Any) -> Any:
    size = sum(math.prod(array.shape) * array.dtype.itemsize for _, array in named_arrays(found))
    if size > _LIMIT:  # a few compressed bytes can say they are terabytes
        raise ValueError(f"{size >> 20} MB of numbers, more than {_LIMIT >> 20}")
    return _values(found)


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


def merge(shards: list[Path], out: Path) -> None:
    """Merge trajectory files into one, episodes numbered in the order given; unknown keys of the JSON are kept.

    It is synced to disk before it gets its name.
    """
    merged: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    sizes = [shard.stat().st_size for shard in shards]
    with atomic_file(out, sync=True) as tmp:
        with reserved(tmp, sum(sizes) + _MARGIN * (1 + len(sizes))) as target:
            for shard in shards:
                data = read_json(shard)
                merged = merged or {key: value for key, value in data.items() if key != "episodes"}
                with open_trajectory(shard) as source:
                    for episode in data["episodes"]:
                        number = len(episodes)
                        copy_episode(source, episode["episode_id"], target, number)
                        episodes.append({**episode, "episode_id": number})
        # the JSON first: an HDF5 file that is there always has its JSON
        write_json(out.with_suffix(".json"), {**merged, "episodes": episodes}, sync=True)


def damage_of(path: Path, seeds: Sequence[int]) -> str:
    """Return what is wrong with a merged file that must hold these seeds in order, by its metadata; empty: nothing."""
    try:
        with open_trajectory(path) as file:
            said = read_json(path)["episodes"]
            found = [one_seed(episode.get("episode_seed")) for episode in said]
            if found != list(seeds) or len(file) != len(found):
                raise DatasetError("other episodes", expected=len(seeds), found=f"{len(found)}, {len(file)} as HDF5")
            for episode in said:
                where = f"traj_{episode['episode_id']}"
                group: Any = open_episode(file, episode["episode_id"])
                with readable(where):
                    group.visititems(lambda *_: None)
                    steps = len(group["actions"])
                if steps != episode.get("elapsed_steps", steps):
                    expected = f"{episode['elapsed_steps']} actions"
                    raise DatasetError("this episode is damaged", where=where, expected=expected, found=steps)
    except DatasetError as error:
        return str(error)
    return ""
