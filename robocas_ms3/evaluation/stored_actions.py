"""Stored actions of a result: one compressed NumPy archive per episode, ``actions/000012.npz``.

An archive has one array, ``actions`` (T, A) float32: the actions of the T executed policy steps in the convention of
the policy, without action noise. Equal actions give equal bytes.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Container
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, open_npz
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import atomic_file
from robocas_ms3.evaluation.outcomes import Outcome

ACTIONS = "actions"
"""Folder of the archives in a result, and name of the array in an archive."""
_FILE_NAME = re.compile(r"(\d{6,})\.npz")
_LARGEST_STEPS = 10**7  # as the rules of a protocol allow
_OTHER_BYTES = 4096  # of an archive, in addition to the values


def find_actions_file(folder: Path, episode: int) -> Path:
    """Return the path of the stored actions of an episode in the folder of a result."""
    return folder / ACTIONS / f"{episode:06d}.npz"


def hash_actions(actions: NDArray[np.float32]) -> str:
    """Return the hex SHA-256 of the bytes of actions (T, A): row after row, little-endian float32."""
    return hashlib.sha256(np.ascontiguousarray(actions, "<f4").tobytes()).hexdigest()


def write_actions(folder: Path, episode: int, actions: NDArray[np.float32]) -> None:
    """Write the actions (T, A) of an episode to its file in the folder of a result, and flush it to the disk."""
    with atomic_file(find_actions_file(folder, episode), sync=True) as tmp:
        np.savez_compressed(tmp, actions=np.ascontiguousarray(actions, "<f4"))


def read_actions(folder: Path, outcome: Outcome, size: int) -> NDArray[np.float32]:
    """Read the stored actions (T, A) float32 of an episode, with T = ``outcome.steps``.

    Args:
        folder: folder of the result.
        outcome: outcome of the episode.
        size: number A of numbers per action.

    Raises:
        EvaluationError: the file is missing or damaged, or its actions do not fit the outcome.
    """
    path, fix = find_actions_file(folder, outcome.episode), "Restore the file, or evaluate again with --overwrite."
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


def delete_other_actions(folder: Path, episodes: Container[int]) -> None:
    """Delete the stored actions of episodes that are not in ``episodes``, such as those of a killed run."""
    for path in folder.glob(f"{ACTIONS}/*.npz"):
        match = _FILE_NAME.fullmatch(path.name)
        if match and int(match[1]) not in episodes:
            path.unlink()
