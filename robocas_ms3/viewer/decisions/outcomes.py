"""Outcome classes of candidates, by which the page and the contact sheet colour them."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.demos.candidates.candidates_file import CandidateFile

Outcome = Literal["infeasible", "failed", "success", "helped"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
"""Outcome classes, in the order in which they are drawn; later ones are on top."""
COLOURS: dict[Outcome, tuple[int, int, int]] = {
    "infeasible": (150, 156, 164),
    "failed": (235, 80, 55),
    "success": (60, 140, 255),
    "helped": (40, 200, 110),
}
"""RGB colour of each outcome class."""
MOVES = ("push", "lift")
"""Primitives that move an obstacle away, and can therefore help."""


def classify_outcomes(file: CandidateFile) -> NDArray[np.str_]:
    """Return the outcome class (N,) of each candidate of a file.

    A push or lift that makes the target easier to grasp has the class "helped", also if it did not reach its own goal.
    """
    candidates, labels = file.candidates, file.labels
    helped = np.isin(candidates["primitive"], MOVES) & labels.for_target(labels.helped)
    conditions = [~candidates["feasible"], helped, candidates["success"]]
    return np.select(conditions, ["infeasible", "helped", "success"], "failed")
