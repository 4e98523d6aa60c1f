"""The outcome of one episode, as results record it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)

from robocas_ms3.core.strict import mistakes
from robocas_ms3.core.words import printable
from robocas_ms3.evaluation.protocol import Episode
from robocas_ms3.scenes.task_specs import STAGES as STAGES_ON_THE_WAY
from robocas_ms3.scenes.task_specs import TASKS

if TYPE_CHECKING:
    from robocas_ms3.evaluation.rollout import Rollout  # which imports the tasks; results are read without

# evaluation_v0.md and the paper's table: reach, pick, recognise, clear
STAGES = {"RA": "reached_any", "PA": "picked_any", "RR": "reached_target", "CO": "obstacles_cleared"}


def _as_written(value: Any, check: ValidatorFunctionWrapHandler) -> Any:
    check(value)
    return value


Number = Annotated[float, Field(ge=-1e12, le=1e12), WrapValidator(_as_written)]
"""Whole if the file has it whole: what is written again says the same."""
Measure = Annotated[float, Field(ge=0, le=1e12), WrapValidator(_as_written)]
Count = Annotated[int, Field(ge=0, le=10**12)]


class _Move(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")

    object: str
    step: NonNegativeInt
    needed: bool
    in_order: bool


class _Order(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")

    moved: list[_Move]
    needed: list[str]
    left: NonNegativeInt
    score: Annotated[float, Field(ge=0, le=1)] | None


def check_order(order: dict[str, Any]) -> dict[str, Any]:
    """Return what `retrieval_order` returned, as it is.

    Raises:
        ValueError: a key is missing, or a value is of another type or out of range.
    """
    try:
        _Order.model_validate(order)
    except ValidationError as error:
        wrong = mistakes(error, _Order)[0]
        raise ValueError(f"{wrong.what}, expected {wrong.expected}, found {wrong.found}") from error
    return order


@dataclass(frozen=True)
class Outcome:
    """What came of an episode.

    Attributes:
        episode: its number in the protocol.
        task: short name.
        config: name of its configuration.
        seed: of its scene.
        split: of the protocol.
        success: the task had succeeded at some moment.
        success_at_end: it had at the last one.
        success_v0: upstream's rule held at the last one; never where there is no basket.
        steps: policy steps.
        seconds: of the scene.
        failure_stage: see `failure_stage`; empty: it succeeded.
        error: why.
        flags: by stage or rule, the policy step after which it first held.
        flag_seconds: the same in s of the scene.
        measures: ``path_length`` m, ``contact_impulse`` N s, ``disturbed_most``, ``fallen``; ``welds`` with the weld.
        inference_ms: clock time of the policy a step.
        p_vis: share of the target that is seen from above.
        retrieval: in tasks with obstacles to clear: what was moved before the target, see `retrieval_order`.
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
    measures: dict[str, Number] = field(default_factory=dict)
    inference_ms: Measure = 0.0
    p_vis: Annotated[float, Field(ge=0, le=1), WrapValidator(_as_written)] | None = None
    retrieval: Annotated[dict[str, Any], AfterValidator(check_order)] | None = None

    @classmethod
    def of(cls, played: Rollout, episode: Episode, objects: Sequence[str]) -> Outcome:
        """What is kept of an episode that was played, with objects of these ids."""
        flags, held_at, order = played.flags, played.flags.get("target_grasped"), None
        if played.retrieval is not None:
            cleared = flags.get("obstacles_cleared") is not None
            order = retrieval_order(played.retrieval, objects, held_at, cleared=cleared)
        return cls(
            episode=episode.episode,
            task=episode.task,
            config=episode.config,
            seed=episode.seed,
            split=episode.split,
            success=flags.get("success") is not None,
            success_at_end=played.at_end.get("success", False),
            success_v0=played.at_end.get("success_v0", False),
            steps=played.steps,
            seconds=round(played.seconds, 4),
            failure_stage=failure_stage(flags, played.error, TASKS[episode.task].stages),
            error=printable(played.error),  # a text of whoever wrote the policy
            flags=flags,
            flag_seconds=played.flag_seconds,
            measures=played.measures,
            inference_ms=round(1000 * played.inference_seconds / max(played.steps, 1), 3),
            p_vis=episode.p_vis,
            retrieval=order,
        )

    def without_clock(self) -> dict[str, Any]:
        """All but what a clock said: the same for the same seed and policy."""
        return {name: value for name, value in asdict(self).items() if name != "inference_ms"}


def failure_stage(flags: dict[str, int | None], error: str = "", order: Sequence[str] = STAGES_ON_THE_WAY) -> str:
    """The stage an episode did not come to, next after the furthest that it did come to.

    A target that is pulled out of its heap was reached though its obstacles were never cleared, so stages that were
    left out on the way do not count. ``placed``: it came to all of them, as when the target was lifted; ``error``: the
    episode was broken off; empty: success.

    Args:
        flags: by stage, when it was come to; stages that are not there are not the environment's.
        error: that broke the episode off.
        order: of the stages, a task's (`TaskSpec.stages`).
    """
    if error:
        return "error"
    if flags.get("success") is not None:
        return ""
    stages = [stage for stage in order if stage in flags]
    came = [number for number, stage in enumerate(stages) if flags[stage] is not None]
    following = came[-1] + 1 if came else 0
    return stages[following] if following < len(stages) else "placed"


def retrieval_order(
    kept: NDArray[np.integer], objects: Sequence[str], held_at: int | None, *, cleared: bool
) -> dict[str, Any]:
    """What a result says of an episode's order.

    Args:
        kept: (K, 3) of `metrics.RetrievalOrder.read`.
        objects: ids by slot.
        held_at: policy step after which the target was first held; None: it never was.
        cleared: whether the obstacles had been cleared before.

    Returns:
        ``moved``, what was moved before the target: ``object``, ``step``, ``needed``, ``in_order`` each, by step;
        ``needed``: ids; ``left``: how many of these had not been moved when the target was taken from a heap that was
        not cleared; ``score``: how many were needed and moved in order, of all that were moved or left; 1 where nothing
        was; None where the target was never held.
    """
    order = [slot for slot in np.argsort(kept[:, 0], kind="stable").tolist() if kept[slot, 0]]
    moved = [
        {
            "object": objects[slot],
            "step": int(kept[slot, 0]),
            "needed": bool(kept[slot, 1]),
            "in_order": bool(kept[slot, 2]),
        }
        for slot in order
    ]
    left = 0 if cleared or held_at is None else int(((kept[:, 0] == 0) & (kept[:, 1] == 1)).sum())
    right, of = int(kept[:, 2].sum()), len(moved) + left
    score = None if held_at is None else 1.0 if of == 0 else round(right / of, 4)
    wanted = [objects[slot] for slot in np.flatnonzero(kept[:, 1]).tolist()]
    return {"moved": moved, "needed": wanted, "left": left, "score": score}


class RetrievalSummary(NamedTuple):
    """Of several episodes, those in which the target was held.

    Attributes:
        held: how many these are.
        score: mean of theirs.
        moved: mean number of objects moved before the target.
        needed: share of these that were needed.
        left: mean number that was left in the way.
    """

    held: int
    score: float
    moved: float
    needed: float
    left: float


def summarize_retrieval(found: Iterable[dict[str, Any] | None]) -> RetrievalSummary | None:
    """Sum up `retrieval_order` several episodes; None: the target was held in none."""
    held = [one for one in found if one is not None and one["score"] is not None]
    if not held:
        return None
    moved = [move for one in held for move in one["moved"]]
    return RetrievalSummary(
        held=len(held),
        score=sum(one["score"] for one in held) / len(held),
        moved=len(moved) / len(held),
        needed=sum(move["needed"] for move in moved) / max(len(moved), 1),
        left=sum(one["left"] for one in held) / len(held),
    )
