"""From the motion of a recording to the arrays of an episode: pure maths, no simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.schema import EPISODE_INFO
from robocas_ms3.demos.recordings.motion import Motion
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.robots.quantities import QUANTITIES


def episode_arrays(motion: Motion, instruction: str, subgoals: Sequence[SubGoal]) -> dict[str, np.ndarray]:
    """Return the arrays of ``episode_info.npz`` without the embeddings of its texts, see `with_embeddings`.

    Args:
        motion: at the T sampled states.
        instruction: the whole episode's.
        subgoals: from ``sample_subgoals``.
    """
    of_steps = [goal for goal in subgoals for _ in range(goal.last - goal.first + 1)]
    values = {
        **{quantity.name: quantity.recorded(motion) for quantity in QUANTITIES if quantity.recorded},
        "episode_length": len(motion.qpos),
        "language_goal": instruction,
        "step_lang_goals": [goal.goal_description for goal in of_steps],
        "step_goal_type": [goal.goal_type for goal in of_steps],
    }
    return {spec.name: spec.cast(values[spec.name]) for spec in EPISODE_INFO if spec.name in values}


def with_embeddings(arrays: Mapping[str, NDArray], embed: Callable[[list[str]], NDArray]) -> dict[str, NDArray]:
    """Return the arrays and the embeddings of instruction and sub-goals, in the schema's order.

    Args:
        arrays: of `episode_arrays`.
        embed: texts -> (N, 384).
    """
    made = {
        **arrays,
        "language_embedding": embed([str(arrays["language_goal"])])[0],
        "step_goal_embs": embed(arrays["step_lang_goals"].tolist()),
    }
    return {spec.name: spec.cast(made[spec.name]) for spec in EPISODE_INFO if spec.name in made}
