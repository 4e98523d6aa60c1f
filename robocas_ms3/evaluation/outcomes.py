"""Outcome of an episode, as recorded in results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from robocas_ms3.scenes.task_specs import STAGES as DEFAULT_STAGES

# Abbreviations of the paper's table (evaluation_v0.md): reach, pick, recognise, clear.
PAPER_STAGES = {"RA": "reached_any", "PA": "picked_any", "RR": "reached_target", "CO": "obstacles_cleared"}

Measure = Annotated[int | float, Field(ge=0, le=1e12)]  # int stays int, so that a value is written as it was read
Fraction = Annotated[int | float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0, le=10**12)]


@dataclass(frozen=True)
class MovedObject:
    """An object that was moved before the target.

    Attributes:
        object: id of the object.
        step: policy step after which the object was first moved.
        needed: whether the object had to be moved.
        in_order: whether it was needed and moved after the objects on top of it.
    """

    object: str
    step: Count
    needed: bool
    in_order: bool


@dataclass(frozen=True)
class Retrieval:
    """Order in which objects were moved before the target of a heap.

    Attributes:
        moved: moved objects, sorted by step.
        needed: ids of the objects that had to be moved (`metrics.RetrievalOrder`).
        left: number of needed objects that were not moved before the target was grasped; 0 if the heap was cleared.
        score: fraction of the moved and left objects that were needed and moved in order; 1 without such objects;
            None if the target was never held.
    """

    moved: list[MovedObject]
    needed: list[str]
    left: Count
    score: Fraction | None

    @classmethod
    def from_record(
        cls, record: NDArray[np.integer], objects: Sequence[str], held_at: int | None, *, cleared: bool
    ) -> Retrieval:
        """Return the order from a record of `metrics.RetrievalOrder.read`.

        Args:
            record: (K, 3) values of each object.
            objects: ids of the objects by slot.
            held_at: policy step after which the target was first held; None: never.
            cleared: whether the obstacles were cleared in the episode.
        """
        slots: list[int] = [slot for slot in np.argsort(record[:, 0], kind="stable").tolist() if record[slot, 0]]
        moved = [
            MovedObject(objects[slot], int(record[slot, 0]), *(bool(x) for x in record[slot, 1:])) for slot in slots
        ]
        left = 0 if cleared or held_at is None else int(((record[:, 0] == 0) & (record[:, 1] == 1)).sum())
        needed = [name for name, is_needed in zip(objects, record[:, 1], strict=False) if is_needed]
        return cls(moved, needed, left, retrieval_score(moved, left, held_at))


def retrieval_score(moved: Sequence[MovedObject], left: int, held_at: int | None) -> float | None:
    """Return the score of a retrieval order, 0..1; None if the target was never held (`Retrieval`)."""
    if held_at is None:
        return None
    right, total = sum(move.needed and move.in_order for move in moved), len(moved) + left
    return round(right / total, 4) if total else 1.0


@dataclass(frozen=True)
class Outcome:
    """Outcome of an episode: a line of ``episodes.jsonl``.

    Attributes:
        episode: number of the episode in the protocol.
        task: short name of the evaluated task.
        config: name of the task configuration.
        seed: seed of the scene.
        split: split of the protocol.
        success: whether the task succeeded at some step.
        success_at_end: whether the task succeeded at the last step.
        success_v0: whether RoboCAS-v0's rule held at the last step; False without a basket.
        steps: number of policy steps.
        seconds: simulated time.
        failure_stage: first stage not reached (`failure_stage`); empty: success.
        error: error that ended the episode; empty: no error.
        flags: policy step after which each stage or rule first held; None: never.
        flag_seconds: simulated time after which each stage or rule first held; None: never.
        measures: ``path_length`` m, ``contact_impulse`` N s, ``disturbed_most``, ``fallen``; ``welds`` with the weld.
        inference_ms: clock time of the policy per step.
        p_vis: visible fraction of the target from above.
        retrieval: order in which objects were moved, only in tasks with obstacles to clear.
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
        """Return the values that are equal for equal seed and policy: all but clock times."""
        return {name: value for name, value in asdict(self).items() if name != "inference_ms"}


def failure_stage(flags: dict[str, int | None], error: str = "", order: Sequence[str] = DEFAULT_STAGES) -> str:
    """Return the first stage not reached: the stage after the furthest reached stage.

    Skipped stages do not count: a target can be pulled out of a heap that was never cleared. Stages that are missing
    in ``flags`` do not exist in the environment. ``placed``: the episode reached all stages, but did not succeed;
    ``error``: an error ended the episode; empty: success.
    """
    if error:
        return "error"
    if flags.get("success") is not None:
        return ""
    stages = [stage for stage in order if stage in flags]
    reached = [number for number, stage in enumerate(stages) if flags[stage] is not None]
    following = reached[-1] + 1 if reached else 0
    return stages[following] if following < len(stages) else "placed"
