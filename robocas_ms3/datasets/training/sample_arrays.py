"""What training samples are made of: an episode's actions, state, texts and embeddings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import one_line
from robocas_ms3.datasets.actions import ACTION_ARRAYS, episode_actions
from robocas_ms3.datasets.sources.protocol import EpisodeSource
from robocas_ms3.datasets.training.options import SampleOptions
from robocas_ms3.scenes.language.templates import GOAL_TYPES


def check_holds(source: EpisodeSource, options: SampleOptions) -> None:
    """Raise DatasetError if a source does not hold what samples are made of."""
    there, cameras = source.cameras, tuple(options.cameras)
    if set(cameras) - set(there) or len(set(cameras)) < len(cameras):
        fix = "" if there else "Pass cameras=(), or make images with robocas convert."
        expected, found = f"some of {', '.join(there) or 'none'}, each once", ", ".join(cameras)
        raise DatasetError("no such cameras", where=source.root, expected=expected, found=found, fix=fix)
    if options.depth and not (source.has_depth and cameras):
        found = "no cameras" if source.has_depth else "no depth"
        raise DatasetError("there is no depth here", where=source.root, found=found, fix="Pass depth=False.")
    if options.embedding and not source.has_embeddings:
        fix = "Pass embedding=False, or convert the trajectory with embeddings."
        raise DatasetError("there are no embeddings here", where=source.root, fix=fix)


_SEE_VALIDATE = "robocas validate says more."
_TYPE_INDEX: dict[str, int] = {kind: index for index, kind in enumerate(GOAL_TYPES)}


def type_index(goal_type: str) -> int:
    """Index of a sub-goal's type in ``GOAL_TYPES``; -1 = unknown."""
    return _TYPE_INDEX.get(goal_type, -1)


def checked_actions(arrays: Mapping[str, NDArray], where: str) -> NDArray[np.float32]:
    """Return the actions (T, 7) of an episode, see `episode_actions`."""
    _check_finite(arrays, where)
    try:
        return episode_actions(arrays)
    except ValueError as error:
        raise DatasetError(
            "these arrays make no actions", where=where, found=one_line(error), fix=_SEE_VALIDATE
        ) from error


def _check_finite(arrays: Mapping[str, NDArray], where: str) -> None:
    for key, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise DatasetError("not a number", where=f"{where}, {key}", fix=_SEE_VALIDATE)


def read_episode(
    source: EpisodeSource, number: int, state: Sequence[str], *, embedding: bool, subgoals: bool
) -> dict[str, Any]:
    """Read what the samples of an episode are made of, except images; ``state``: arrays that make up the state.

    Return ``action`` (T, 7), ``first_command``, ``instruction``; ``state`` (T, D), ``texts``, ``subgoal_type`` (T,) and
    the embeddings where they are wanted.
    """
    keys = (*ACTION_ARRAYS, *state, "language_goal")
    keys += ("step_lang_goals", "step_goal_type") * subgoals
    keys += ("language_embedding",) * embedding + ("step_goal_embs",) * (embedding and subgoals)
    arrays = source.episode(number).read(keys)
    length, where = source.lengths[number], f"{source.root}, episode {number}"
    for key, array in arrays.items():
        if key not in {"language_goal", "language_embedding"} and len(array) != length:
            what = "another length than the overview says"
            raise DatasetError(what, where=f"{where}, {key}", expected=length, found=len(array))
    _check_finite(arrays, where)
    made: dict[str, Any] = {
        "action": checked_actions(arrays, where),
        "first_command": float(arrays["gripper_status"][0]),
        "instruction": str(arrays["language_goal"]),
    }
    if state:
        columns = [arrays[key].reshape(length, -1) for key in state]
        made["state"] = np.concatenate(columns, axis=1).astype(np.float32)
    if embedding:
        made["language_embedding"] = arrays["language_embedding"]
    if subgoals:
        made["texts"] = arrays["step_lang_goals"].tolist()
        made["subgoal_type"] = np.array([type_index(kind) for kind in arrays["step_goal_type"].tolist()])
        if embedding:
            made["subgoal_embedding"] = arrays["step_goal_embs"]
    return made
