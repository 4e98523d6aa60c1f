"""The outcome of one episode, as results record it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from robocas_ms3.scenes.task_specs import STAGES as DEFAULT_STAGES

# evaluation_v0.md and the paper's table: reach, pick, recognise, clear
PAPER_STAGES = {"RA": "reached_any", "PA": "picked_any", "RR": "reached_target", "CO": "obstacles_cleared"}

Measure = Annotated[int | float, Field(ge=0, le=1e12)]  # whole if the file has it whole, so that it is written the same
Fraction = Annotated[int | float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0, le=10**12)]


@dataclass(frozen=True)
class MovedObject:
    """An object that was moved before the target: at which policy step, and whether it had to be and came in order."""

    object: str
    step: Count
    needed: bool
    in_order: bool


@dataclass(frozen=True)
class Retrieval:
    """The order in which objects were moved before the target of a heap.

    Attributes:
        moved: by step.
        needed: ids of the objects that had to be moved (`metrics.RetrievalOrder`).
        left: number of needed objects that had not been moved when the target was taken from a heap that was not
            cleared.
        score: share of the objects moved or left that were needed and moved in order; 1 if there are none; None if the
            target was never held.
    """

    moved: list[MovedObject]
    needed: list[str]
    left: Count
    score: Fraction | None

    @classmethod
    def from_record(
        cls, record: NDArray[np.integer], objects: Sequence[str], held_at: int | None, *, cleared: bool
    ) -> Retrieval:
        """Make it from a record (K, 3) of `metrics.RetrievalOrder.read`, and the ids of the objects by slot.

        ``held_at``: policy step after which the target was first held; ``cleared``: whether the obstacles had been
        cleared before.
        """
        slots: list[int] = [slot for slot in np.argsort(record[:, 0], kind="stable").tolist() if record[slot, 0]]
        moved = [
            MovedObject(objects[slot], int(record[slot, 0]), *(bool(x) for x in record[slot, 1:])) for slot in slots
        ]
        left = 0 if cleared or held_at is None else int(((record[:, 0] == 0) & (record[:, 1] == 1)).sum())
        needed = [name for name, is_needed in zip(objects, record[:, 1], strict=False) if is_needed]
        return cls(moved, needed, left, retrieval_score(moved, left, held_at))


def retrieval_score(moved: Sequence[MovedObject], left: int, held_at: int | None) -> float | None:
    if held_at is None:
        return None
    right, total = sum(move.needed and move.in_order for move in moved), len(moved) + left
    return round(right / total, 4) if total else 1.0


@dataclass(frozen=True)
class Outcome:
    """The outcome of an episode: a line of ``episodes.jsonl``.

    Attributes:
        episode: its number in the protocol.
        task: short name.
        config: name of its configuration.
        seed: of its scene.
        split: of the protocol.
        success: whether the task succeeded at some step.
        success_at_end: whether it succeeded at the last step.
        success_v0: whether RoboCAS-v0's rule held at the last step; never without a basket.
        steps: policy steps.
        seconds: simulated time.
        failure_stage: see `failure_stage`; empty: success.
        error: why it was ended early; empty: it was not.
        flags: by stage or rule, the policy step after which it first held.
        flag_seconds: the same in s of simulated time.
        measures: ``path_length`` m, ``contact_impulse`` N s, ``disturbed_most``, ``fallen``; ``welds`` with the weld.
        inference_ms: clock time of the policy per step.
        p_vis: share of the target that is visible from above.
        retrieval: in tasks with obstacles to clear, the order in which objects were moved.
    """

    episode: Count
    task: str
    config: str
    seed: Count
    split: str
    success: bool
    success_at_end: bool
    success_v0: bool
    steps: Count
    seconds: Measure
    failure_stage: str
    error: str = ""
    flags: dict[str, Count | None] = field(default_factory=dict)
    flag_seconds: dict[str, Measure | None] = field(default_factory=dict)
    measures: dict[str, Measure] = field(default_factory=dict)
    inference_ms: Measure = 0.0
    p_vis: Fraction | None = None
    retrieval: Retrieval | None = None

    def reproducible_values(self) -> dict[str, Any]:
        """Return the values that are the same for the same seed and policy."""
        return {name: value for name, value in asdict(self).items() if name != "inference_ms"}


def failure_stage(flags: dict[str, int | None], error: str = "", order: Sequence[str] = DEFAULT_STAGES) -> str:
    """Return the first stage that an episode did not reach after the furthest one that it reached.

    Stages that were skipped do not count: a target can be pulled out of a heap that was never cleared. Stages that are
    missing in ``flags`` do not exist in the environment. ``placed``: it reached all of them, but did not succeed;
    ``error``: it was ended by an error; empty: success.
    """
    if error:
        return "error"
    if flags.get("success") is not None:
        return ""
    stages = [stage for stage in order if stage in flags]
    reached = [number for number, stage in enumerate(stages) if flags[stage] is not None]
    following = reached[-1] + 1 if reached else 0
    return stages[following] if following < len(stages) else "placed"
