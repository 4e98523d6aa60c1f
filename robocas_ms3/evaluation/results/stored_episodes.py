"""Stored actions and checkpoints of a result: a compressed NumPy archive per episode and kind.

``actions/000012.npz`` has one array, ``actions`` (T, A) float32: the actions of the T executed policy steps in the
convention of the policy, without action noise. ``checkpoints/000012.npz`` has the arrays of `outcomes.Checkpoints`.
Equal values give equal bytes.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, open_npz
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import atomic_file
from robocas_ms3.evaluation.results.outcomes import NO_CHECKPOINTS, Checkpoints, Outcome

ACTIONS = "actions"
"""Folder of the archives with actions in a result, and name of their array."""
CHECKPOINTS = "checkpoints"
"""Folder of the archives with checkpoints in a result."""
_FILE_NAME = re.compile(r"(\d{6,})\.npz")
_LARGEST_STEPS = 10**7  # as the rules of a protocol allow
_OTHER_BYTES = 4096  # of an archive, in addition to the values
_LARGEST_STATE = 2**14  # numbers per state
_FIX = (
    "Restore the file, or evaluate again with --overwrite. Entries of the leaderboard have the actions of some "
    "episodes only: check them with robocas leaderboard audit."
)


def find_actions_file(folder: Path, episode: int) -> Path:
    """Return the path of the stored actions of an episode in the folder of a result."""
    return folder / ACTIONS / f"{episode:06d}.npz"


def find_checkpoints_file(folder: Path, episode: int) -> Path:
    """Return the path of the checkpoints of an episode in the folder of a result."""
    return folder / CHECKPOINTS / f"{episode:06d}.npz"


def hash_actions(actions: NDArray[np.float32]) -> str:
    """Return the hex SHA-256 of the bytes of actions (T, A): row after row, little-endian float32."""
    return hashlib.sha256(np.ascontiguousarray(actions, "<f4").tobytes()).hexdigest()


def write_actions(folder: Path, episode: int, actions: NDArray[np.float32]) -> None:
    """Write the actions (T, A) of an episode to its file in the folder of a result, and flush it to the disk."""
    _write(find_actions_file(folder, episode), {ACTIONS: np.ascontiguousarray(actions, "<f4")})


def write_checkpoints(folder: Path, episode: int, checkpoints: Checkpoints) -> None:
    """Write the checkpoints of an episode in the folder of a result, and flush them to the disk; no file if empty."""
    if len(checkpoints.steps):
        steps, states = np.ascontiguousarray(checkpoints.steps, "<i4"), np.ascontiguousarray(checkpoints.states, "<f4")
        _write(find_checkpoints_file(folder, episode), {"steps": steps, "states": states})


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    with atomic_file(path, sync=True) as tmp:
        np.savez_compressed(tmp, allow_pickle=False, **arrays)


def read_actions(folder: Path, outcome: Outcome, size: int) -> NDArray[np.float32]:
    """Read the stored actions (T, A) float32 of an episode, with T = ``outcome.steps``.

    Args:
        folder: folder of the result.
        outcome: outcome of the episode.
        size: number A of numbers per action.

    Raises:
        EvaluationError: the file is missing or damaged, or its actions do not fit the outcome.
    """
    path, fix = find_actions_file(folder, outcome.episode), _FIX
    steps = min(outcome.steps, _LARGEST_STEPS)
    try:
        with open_npz(path, limit=4 * steps * size + _OTHER_BYTES) as file:
            actions = np.asarray(file[ACTIONS])
    except (*DAMAGED_FILE_ERRORS, KeyError) as error:
        what = "cannot read the stored actions" if path.exists() else "no stored actions"
        raise EvaluationError(what, where=path, found=error if path.exists() else "", fix=fix) from error
    if actions.dtype != np.dtype("<f4") or actions.shape != (outcome.steps, size):
        expected, found = f"({outcome.steps}, {size}) float32", f"{actions.shape} {actions.dtype}"
        what = "the stored actions have another shape or type"
        raise EvaluationError(what, where=path, expected=expected, found=found, fix=fix)
    if not np.isfinite(actions).all():
        raise EvaluationError("NaN or infinite value in the stored actions", where=path, fix=fix)
    if (found := hash_actions(actions)) != outcome.actions_hash:
        expected = f"actions_hash {outcome.actions_hash or 'missing'}"
        raise EvaluationError(
            "the stored actions have another hash", where=path, expected=expected, found=found, fix=fix
        )
    return actions


def read_checkpoints(folder: Path, outcome: Outcome) -> Checkpoints:
    """Read the checkpoints of an episode; none if there is no file.

    Raises:
        EvaluationError: the file is damaged, or its checkpoints do not fit the outcome.
    """
    path = find_checkpoints_file(folder, outcome.episode)
    if not path.exists():
        return NO_CHECKPOINTS
    limit = 4 * (min(outcome.steps, _LARGEST_STEPS) + 1) * (_LARGEST_STATE + 1) + _OTHER_BYTES
    try:
        with open_npz(path, limit=limit) as file:
            steps, states = np.asarray(file["steps"]), np.asarray(file["states"])
    except (*DAMAGED_FILE_ERRORS, KeyError) as error:
        raise EvaluationError("cannot read the checkpoints", where=path, found=error, fix=_FIX) from error
    count = len(steps) if steps.ndim else 0
    fits = (
        steps.dtype == np.dtype("<i4")
        and states.dtype == np.dtype("<f4")
        and (steps.ndim, states.ndim) == (1, 2)
        and len(states) == count > 0
        and bool((np.diff(steps, prepend=0) > 0).all())
        and int(steps[-1]) == outcome.steps
        and bool(np.isfinite(states).all())
    )
    if not fits:
        expected = f"ascending int32 steps up to {outcome.steps}, and a finite float32 state per step"
        found = f"steps {steps.shape} {steps.dtype}, states {states.shape} {states.dtype}"
        raise EvaluationError("invalid checkpoints", where=path, expected=expected, found=found, fix=_FIX)
    return Checkpoints(steps, states)


def delete_other_episodes(folder: Path, episodes: Container[int]) -> None:
    """Delete stored actions and checkpoints of episodes that are not in ``episodes``, such as those of a killed run."""
    for path in (path for kind in (ACTIONS, CHECKPOINTS) for path in folder.glob(f"{kind}/*.npz")):
        match = _FILE_NAME.fullmatch(path.name)
        if match and int(match[1]) not in episodes:
            path.unlink()
