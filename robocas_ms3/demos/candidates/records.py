"""Values of one decision in memory, before they are written to ``candidates.h5``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.demos.candidates.schema import DecisionKind


def candidates_file_name(episode: str) -> str:
    """Return the name of the file with the candidates of an episode whose trajectory file has the stem ``episode``."""
    return f"candidates_{episode}.h5"


@dataclass
class DecisionRecord:
    """A decision with its candidates.

    Attributes:
        values: by name of a `schema.DECISION_FIELDS`, without ``first_candidate`` and ``candidate_count``. Arrays have
            the K slots of the episode.
        state: state of the simulator before the decision, as one row of ``env_states`` of a trajectory file, without
            ``controller``: ``{"actors": {name: (13,)}, "articulations": {name: (D,)}, "task": {name: (D,)}}``.
        candidates: one dict per candidate, by name of a `schema.CANDIDATE_FIELDS`, without ``decision_row``.
    """

    values: dict[str, Any]
    state: dict[str, dict[str, NDArray[Any]]]
    candidates: list[dict[str, Any]] = field(default_factory=list)

    @property
    def slots(self) -> int:
        """Number K of object slots."""
        return len(np.asarray(self.values["present"]))


@dataclass
class PathDecision:
    """Decision of an attempt.

    Attributes:
        kind: kind of the decision.
        number: index of its record; None if it is not recorded.
        options: index of the scripted policy's candidate in its record, by its number in the decision.
        chosen: index of the candidate with which the attempt continued; None if it is not in the record.
    """

    kind: DecisionKind
    number: int | None
    options: dict[int, int] = field(default_factory=dict)
    chosen: int | None = None


def mark_episode(records: Sequence[DecisionRecord], path: Sequence[PathDecision]) -> None:
    """Mark the decisions of the recorded episode in the records of a seed.

    The decisions get ``in_episode`` and ``moves_left``, and their chosen candidates get ``chosen``.

    Args:
        records: decisions of all attempts.
        path: decisions of the attempt that succeeded, in order.
    """
    moves_left = 0
    for decision in reversed(path):
        if decision.number is not None:
            record = records[decision.number]
            record.values |= {"in_episode": True, "moves_left": moves_left}
            if decision.chosen is not None:
                record.candidates[decision.chosen]["chosen"] = True
        moves_left += decision.kind == "move"
