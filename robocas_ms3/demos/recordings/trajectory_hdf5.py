"""Write, merge and strictly read the HDF5 files of trajectories.

HDF5 aborts the process if it cannot write its buffers, e.g. on a full disk. Files are therefore written in memory or on
reserved disk space. HDF5 files can refer to other files by links, external storage and virtual datasets. Recordings are
untrusted data, so a file with such references is rejected before it is read.
"""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DocumentError, check_regular_file
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_file, write_json
from robocas_ms3.core.text import one_line
from robocas_ms3.demos.recordings.trajectory_json import parse_seed, read_json

INTENDED_ACTIONS, JOINT_DEVIATIONS = "intended_actions", "joint_deviations"
"""Arrays of an episode with action noise: actions without the noise (S, A), and deviations of the arm joints that the
noise has caused at the end of each control step (S, 7), rad."""
BODIES = ("actors", "articulations")
"""Kinds of states whose rows start with a position and a wxyz quaternion."""

_LENGTH_TOLERANCE = 0.05  # tolerance of the length of quaternions
_HARD_LINK: int = getattr(h5py, "h5l").TYPE_HARD  # noqa: B009  (its stubs lack it)
_MAX_BYTES = 2**30  # bytes of an episode's states: ten thousand steps of forty bodies are 20 MB
_MAX_DEPTH = 4  # maximum nesting of groups in states
_MARGIN_BYTES = 4096  # bytes per episode that a merged file may need in addition


def write_hdf5(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Create an HDF5 file in memory and write it at once.

    Args:
        path: path of the file.
        fill: function that writes the content to the open file.

    Raises:
        OSError: the file cannot be written.
    """
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        fill(file)
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


@contextmanager
def open_reserved(path: Path, size: int) -> Iterator[h5py.File]:
    """Create an HDF5 file with ``size`` bytes reserved on the disk, and open it.

    Raises OSError if the disk is full.
    """
    write_hdf5(path, lambda file: None)
    with path.open("r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, max(size, 1))
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # file systems without preallocation
                raise
    with h5py.File(path, "r+") as file:
        yield file


@contextmanager
def convert_read_errors(where: object, what: str = "damaged episode") -> Iterator[None]:
    """Convert errors of h5py in a ``with`` block to ``DatasetError``.

    Args:
        where: file or place for the message.
        what: fault for the message.
    """
    try:
        yield
    except (OSError, KeyError, RuntimeError, AttributeError, ValueError, TypeError, MemoryError) as error:
        raise DatasetError(what, where=where, found=one_line(error)) from error


def open_trajectory(path: Path) -> h5py.File:
    """Open the HDF5 file of a trajectory for reading; raise ``DatasetError`` if it is missing or damaged."""
    try:
        check_regular_file(path)
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        fix = "Record one with robocas generate."
        raise DatasetError("no such trajectory file", where=path, fix=fix) from error
    except (OSError, DocumentError) as error:
        sizes = re.search(r"truncated file: eof = (\d+),.* stored_eof = (\d+)", str(error))
        found = f"a truncated file: {sizes[1]} of {sizes[2]} bytes" if sizes else one_line(error)
        fix = "Copy or record it again."
        raise DatasetError("not a readable HDF5 file", where=path, found=found, fix=fix) from error


def open_episode(file: h5py.File, number: int) -> h5py.Group:
    """Return the group ``traj_NUMBER`` of an open trajectory file.

    Raises:
        DatasetError: the group is missing or damaged, or contains links to other data.
    """
    name = f"traj_{number}"
    where = f"{file.filename}, {name}"
    with convert_read_errors(where):
        links: Any = file.id.links
        if not links.exists(name.encode()):
            raise KeyError(name)
        group: Any = file[name] if links.get_info(name.encode()).type == _HARD_LINK else None
        if group is None:
            raise _external_reference(where, "a link")
        check_links(group, where)
    return group


def check_links(group: h5py.Group, where: object) -> None:
    """Raise ``DatasetError`` if a group contains soft or external links, also in its subgroups."""
    bad_links: list[bytes] = []

    def is_bad_link(name: bytes, link: Any) -> bool | None:
        return None if link.type == _HARD_LINK else bad_links.append(name) or True

    links: Any = group.id.links
    if links.visit(is_bad_link, info=True):  # visits each group once, even in cycles
        raise _external_reference(f"{where}/{bad_links[0].decode(errors='replace')}", "a link")


def copy_episode(source: h5py.File, number: int, target: h5py.File, new_number: int) -> None:
    """Copy the group of an episode to another trajectory file under a new number."""
    group = open_episode(source, number)
    with convert_read_errors(f"{source.filename}, traj_{number}"):
        group.visititems(lambda _, item: check_stored_in_file(item) if isinstance(item, h5py.Dataset) else None)
        source.copy(group, target, name=f"traj_{new_number}")


def read_actions(episode: h5py.Group) -> NDArray[np.float32]:
    """Read the actions (S, A) of an episode, S > 0; check that they are finite."""
    where = _where(episode)
    actions = _read_rows(episode, "actions")
    if actions.ndim != 2 or len(actions) == 0:
        expected = "an array of shape (steps, A) with at least one step"
        raise DatasetError("episode without actions", where=where, expected=expected, found=f"shape {actions.shape}")
    _check_finite(actions, f"{where}, actions")
    return actions


def read_joint_deviations(episode: h5py.Group, control_steps: int) -> NDArray[np.float32]:
    """Read the deviations (S, 7) of the arm joints that action noise has caused, rad; check shape and values.

    ``control_steps`` is S, the number of actions.
    """
    where, deviations = f"{_where(episode)}, {JOINT_DEVIATIONS}", _read_rows(episode, JOINT_DEVIATIONS)
    if deviations.shape != (control_steps, 7):
        expected = f"shape ({control_steps}, 7)"
        raise DatasetError("damaged episode", where=where, expected=expected, found=f"shape {deviations.shape}")
    _check_finite(deviations, where)
    return deviations


def _read_rows(episode: h5py.Group, name: str) -> NDArray[np.float32]:
    with convert_read_errors(_where(episode)):
        return np.asarray(_load_arrays(_collect_arrays(episode[name], 0)), np.float32)


def read_steps(
    episode: h5py.Group, *, body: str | None = None, extras: bool = False
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Read the actions and states of an episode; check that they are finite.

    Args:
        episode: group of the episode.
        body: name of a body; only states of this body are read. Default: states of all bodies.
        extras: whether to read all other states too, e.g. those of controllers.

    Returns:
        Actions (S, A); states as nested dicts of arrays (S + 1, ...).
    """
    where, actions = _where(episode), read_actions(episode)
    with convert_read_errors(where):
        found: Any = episode["env_states"]
        if not extras:
            kinds = {kind: found[kind] for kind in BODIES if kind in found}
            found = {
                kind: {name: _collect_arrays(of[name], 0) for name in of if body in (None, name)}
                for kind, of in kinds.items()
            }
        states = _load_arrays(_collect_arrays(found, _MAX_DEPTH) if extras else found)
    for name, rows in iterate_arrays(states):
        place, kind = f"{where}, {name}", name.split("/")[0]
        if rows.dtype.kind not in "fbiu" or rows.shape[:1] != (len(actions) + 1,):
            expected = f"{len(actions) + 1} rows of numbers, one more than actions"
            found = f"{rows.dtype} of shape {rows.shape}"
            raise DatasetError("damaged episode", where=place, expected=expected, found=found)
        _check_finite(rows, place)
        if kind in BODIES:
            _check_orientations(rows, name, place)
    return actions, states


def iterate_arrays(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and array of each array in nested dicts; a path has the form ``key/key``."""
    if not isinstance(node, dict):
        yield name, node
        return
    for key, inner in node.items():
        yield from iterate_arrays(inner, f"{name}/{key}" if name else key)


def _check_finite(rows: NDArray[Any], where: str) -> None:
    finite = np.isfinite(rows)
    if not finite.all():
        place = f"{where}, row {int(np.argwhere(~finite)[0, 0])}"
        fix = "Record the episode again."
        raise DatasetError("NaN or infinite value", where=place, expected="finite numbers", fix=fix)


def _check_orientations(rows: NDArray[Any], name: str, where: str) -> None:
    if name.count("/") != 1 or rows.ndim != 2 or rows.shape[1] < 7:
        raise DatasetError(
            "damaged episode", where=where, expected="rows that start with a pose", found=f"shape {rows.shape}"
        )
    length = np.linalg.norm(rows[:, 3:7].astype(np.float64), axis=1)
    wrong = np.flatnonzero(abs(length - 1) > _LENGTH_TOLERANCE)
    if len(wrong):
        place, found = f"{where}, row {wrong[0]}", f"{length[wrong[0]]:g}"
        expected, fix = "a quaternion of length 1", "Record the episode again."
        raise DatasetError("invalid orientation", where=place, expected=expected, found=f"length {found}", fix=fix)


def _collect_arrays(node: Any, depth: int) -> Any:
    """Convert nested groups to dicts of HDF5 datasets, without reading their values."""
    if isinstance(node, h5py.Dataset):
        check_stored_in_file(node)
        return node
    if not depth:
        raise ValueError("expected an array, found a group; groups are nested too deeply")
    # not node.items(), which holds the lock of h5py as long as the traceback of an error exists
    return {name: _collect_arrays(node[name], depth - 1) for name in node}


def _load_arrays(found: Any) -> Any:
    size = sum(math.prod(array.shape) * array.dtype.itemsize for _, array in iterate_arrays(found))
    if size > _MAX_BYTES:  # a small compressed file can declare terabytes
        raise ValueError(f"{size >> 20} MB of arrays, the limit is {_MAX_BYTES >> 20} MB")
    return _load(found)


def _load(found: Any) -> Any:
    return {name: _load(inner) for name, inner in found.items()} if isinstance(found, dict) else found[()]


def check_stored_in_file(array: h5py.Dataset) -> None:
    """Raise ``DatasetError`` if the values of an array are in other files."""
    if array.external or array.is_virtual:
        where = f"{array.file.filename}, {str(array.name).strip('/')}"
        raise _external_reference(where, "an array stored in other files")


def _where(episode: h5py.Group) -> str:
    return f"{episode.file.filename}, {str(episode.name).strip('/')}"


def _external_reference(where: str, found: str) -> DatasetError:
    what, fix = "the recording refers to data outside of its file", "Record the episode again."
    return DatasetError(what, where=where, expected="arrays stored in this file", found=found, fix=fix)


def merge(sources: list[Path], out: Path) -> None:
    """Merge trajectory files to one file; the episodes get new numbers in the given order.

    Unknown JSON keys are kept. The file is synced to disk before it is renamed to ``out``.

    Args:
        sources: trajectory files (.h5), each with a .json file.
        out: merged trajectory file; may be one of the sources.
    """
    merged: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    sizes = [source.stat().st_size for source in sources]
    with atomic_file(out, sync=True) as tmp:
        with open_reserved(tmp, sum(sizes) + _MARGIN_BYTES * (1 + len(sizes))) as target:
            for path in sources:
                data = read_json(path)
                merged = merged or {key: value for key, value in data.items() if key != "episodes"}
                with open_trajectory(path) as source:
                    for episode in data["episodes"]:
                        number = len(episodes)
                        copy_episode(source, episode["episode_id"], target, number)
                        episodes.append({**episode, "episode_id": number})
        # the JSON first, so that an HDF5 file never lacks its JSON
        write_json(out.with_suffix(".json"), {**merged, "episodes": episodes}, sync=True)


def find_violation(path: Path, seeds: Sequence[int]) -> str:
    """Check that a trajectory file contains the episodes of these seeds in order.

    Only metadata is read.

    Returns:
        Message about the first violation, or an empty string.
    """
    try:
        with open_trajectory(path) as file:
            entries = read_json(path)["episodes"]
            found = [parse_seed(episode.get("episode_seed")) for episode in entries]
            if found != list(seeds) or len(file) != len(found):
                expected = f"{len(seeds)} episodes with the given seeds in order"
                count = f"{len(found)} in the JSON, {len(file)} in the HDF5 file"
                raise DatasetError("wrong episodes", expected=expected, found=count)
            for episode in entries:
                where = f"traj_{episode['episode_id']}"
                group: Any = open_episode(file, episode["episode_id"])
                with convert_read_errors(where):
                    group.visititems(lambda *_: None)
                    steps = len(group["actions"])
                if steps != episode.get("elapsed_steps", steps):
                    expected = f"{episode['elapsed_steps']} actions"
                    raise DatasetError("damaged episode", where=where, expected=expected, found=f"{steps} actions")
    except DatasetError as error:
        return str(error)
    return ""
