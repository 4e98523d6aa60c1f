"""Values of one decision in memory, before they are written to ``candidates.h5``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
