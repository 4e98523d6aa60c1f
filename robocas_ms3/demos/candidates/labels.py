"""Labels of candidates that follow from the recorded values: cost of clearing each object, and its decrease."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.demos.candidates.tables import Arrays, Tables
from robocas_ms3.planning.clearing_cost import compute_clearing_cost

MIN_BENEFIT = 3.0
"""Least benefit in s of a candidate that helped: the target is less hidden by a tenth of its area."""


@dataclass(frozen=True)
class Labels:
    """Labels of N candidates for each of K object slots as the target.

    Costs are those of `compute_clearing_cost`, and 0 for an object that is held or that the candidate has released into
    the basket. Slots without an object have NaN.

    Attributes:
        cost_before: (N, K) clearing cost of each object before the candidate, s.
        cost_after: (N, K) clearing cost of each object after the candidate, s.
        benefit: (N, K) decrease of the clearing cost, s.
        helped: (N, K) bool, whether the benefit is at least `MIN_BENEFIT` and no object has fallen.
        target_slot: (N,) slot of the target of the decision.
    """

    cost_before: NDArray[np.float64]
    cost_after: NDArray[np.float64]
    benefit: NDArray[np.float64]
    helped: NDArray[np.bool_]
    target_slot: NDArray[np.int64]

    def for_target(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the value (N,) of the instructed target from values (N, K) of all slots."""
        return values[np.arange(len(values)), self.target_slot]


def compute_labels(tables: Tables) -> Labels:
    """Compute the labels of all candidates of a file."""
    rows, slots = tables.candidates["decision_row"], np.arange(tables.slots)
    held_before = tables.decisions["held_slot"][:, None] == slots
    own = tables.candidates["slot"][:, None] == slots  # slot of the object that the candidate moves
    delivered = tables.candidates["held"][:, None] | tables.candidates["in_basket"]
    before = np.where(held_before, 0.0, _clearing_cost(tables.decisions))[rows]
    after = np.where(own & delivered, 0.0, _clearing_cost(tables.candidates))
    benefit = before - after
    helped = (benefit >= MIN_BENEFIT) & ~tables.candidates["fallen"].any(axis=1, keepdims=True)
    return Labels(before, after, benefit, helped, tables.decisions["target_slot"][rows].astype(np.int64))


def _clearing_cost(values: Arrays) -> NDArray[np.float64]:
    cost = compute_clearing_cost(values["obstacles"], values["hidden_fraction"], values["free_grasps"])
    return np.asarray(cost, np.float64)
