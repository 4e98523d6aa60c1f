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
from robocas_ms3.scenes.language.templates import GOAL_TYPES


def check_holds(source: EpisodeSource, cameras: Sequence[str], *, depth: bool, embedding: bool) -> None:
    pictures = source.cameras
    wrong = [camera for camera in cameras if camera not in pictures]
    if wrong and not pictures:
        raise DatasetError(
            "there are no pictures here",
            where=source.root,
            expected="cameras=()",
            found=f"cameras={cameras}",
            fix="Pass cameras=(), or make pictures with robocas convert.",
        )
    if wrong or len(set(cameras)) < len(cameras):
        expected = f"some of {', '.join(pictures)}, each once"
        raise DatasetError("no such camera", where=source.root, expected=expected, found=", ".join(cameras))
    if depth and not (source.has_depth and cameras):
        found = "no cameras" if source.has_depth else "no depth"
        raise DatasetError("there is no depth here", where=source.root, found=found, fix="Pass depth=False.")
    if embedding and not source.has_embeddings:
        raise DatasetError(
            "there are no embeddings here",
            where=source.root,
            fix="Pass embedding=False, or convert the trajectory with embeddings.",
        )


_TYPE_INDEX: dict[str, int] = {kind: index for index, kind in enumerate(GOAL_TYPES)}


def type_index(goal_type: str) -> int:
    """Index of a sub-goal's type in ``GOAL_TYPES``; -1 = unknown."""
    return _TYPE_INDEX.get(goal_type, -1)


def checked_actions(arrays: Mapping[str, NDArray], where: str) -> NDArray[np.float32]:
    """Actions (T, 7) of an episode, see `episode_actions`."""
    for key in ACTION_ARRAYS:
        if not np.isfinite(arrays[key]).all():
            raise DatasetError("not a number", where=f"{where}, {key}", fix="robocas validate says more.")
    try:
        return episode_actions(arrays)
    except ValueError as error:
        raise DatasetError(
            "these arrays make no actions", where=where, found=one_line(error), fix="robocas validate says more."
        ) from error


def read_episode(
    source: EpisodeSource, number: int, state: Sequence[str], *, embedding: bool, subgoals: bool
) -> dict[str, Any]:
    """Read what an episode's samples are made of, all but the pictures.

    Args:
        source: it is in.
        number: of it.
        state: arrays of the schema that make up the state.
        embedding: whether the texts' embeddings are wanted.
        subgoals: whether sub-goals are.

    Returns:
        ``action`` (T, 7), ``first_command``, ``instruction``; ``state`` (T, D), ``texts``, ``subgoal_type`` (T,) and
        the embeddings where they are wanted.

    Raises:
        DatasetError: the file is missing or damaged, an array of another length, or holds what is no number.
    """
    keys = (*ACTION_ARRAYS, *state, "language_goal")
    keys += ("step_lang_goals", "step_goal_type") * subgoals
    keys += ("language_embedding",) * embedding + ("step_goal_embs",) * (embedding and subgoals)
    arrays = source.episode(number).read(keys)
    length = source.lengths[number]
    where = f"{source.root}, episode {number}"
    for key, array in arrays.items():
        if key not in {"language_goal", "language_embedding"} and len(array) != length:
            raise DatasetError(
                "another length than the overview says",
                where=f"{where}, {key}",
                expected=length,
                found=len(array),
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise DatasetError("not a number", where=f"{where}, {key}", fix="robocas validate says more.")
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
