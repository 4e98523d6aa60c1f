"""What a result says of the order in which objects were moved before the target was taken out of its heap."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

from robocas_ms3.core.strict import mistakes


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
    """Return what `order_of` made, as it is.

    Raises:
        ValueError: a key is missing, or a value is of another type or out of range.
    """
    try:
        _Order.model_validate(order)
    except ValidationError as error:
        wrong = mistakes(error, _Order)[0]
        raise ValueError(f"{wrong.what}, expected {wrong.expected}, found {wrong.found}") from error
    return order


def order_of(
    kept: NDArray[np.integer], objects: Sequence[str], held_at: int | None, *, cleared: bool
) -> dict[str, Any]:
    """What a result says of an episode's order.

    Args:
        kept: (K, 3) of `retrieval.Retrieval.read`.
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


class Orders(NamedTuple):
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


def orders(found: Iterable[dict[str, Any] | None]) -> Orders | None:
    """Sum up `order_of` several episodes; None: the target was held in none."""
    held = [one for one in found if one is not None and one["score"] is not None]
    if not held:
        return None
    moved = [move for one in held for move in one["moved"]]
    return Orders(
        held=len(held),
        score=sum(one["score"] for one in held) / len(held),
        moved=len(moved) / len(held),
        needed=sum(move["needed"] for move in moved) / max(len(moved), 1),
        left=sum(one["left"] for one in held) / len(held),
    )
