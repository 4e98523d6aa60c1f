"""Which episodes of a plan's dataset train and which validate."""

from __future__ import annotations

import logging
from pathlib import Path

from robocas_ms3.datasets.manage.splitting import Share, cut, groups_of
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.split import SPLIT_RULE, split_by_seed
from robocas_ms3.plans.plan import Plan

Sides = tuple[list[int], list[int]]
_log = logging.getLogger(__name__)


def rule_of(plan: Plan) -> str:
    """The rule in words, for ``conversion.json``."""
    rule = Share(plan.split.val_share, plan.split.by).rule if plan.split else SPLIT_RULE
    said = [f"{part.name}: {part.split}" for part in plan.parts if part.split]
    return "; ".join([*said, rule if len(said) < len(plan.parts) else ""]).removesuffix("; ")


def sides_of(plan: Plan, root: Path) -> Sides:
    """Training and validation episodes, of the parts that don't say it by the plan's rule.

    Args:
        plan: of the dataset.
        root: the dataset, all of whose episodes are there.

    Raises:
        DatasetError: an episode doesn't say its seed, target or task.
    """
    sides: Sides = ([], [])
    free: list[int] = []
    for number, part in enumerate(plan.parts):
        first = plan.first_episode(number)
        chosen = free if part.split is None else sides[part.split == "val"]
        chosen += range(first, first + part.episodes)
    train, val = _divided(plan, root, free)
    return sorted([*sides[0], *train]), sorted([*sides[1], *val])


def _divided(plan: Plan, root: Path, free: list[int]) -> Sides:
    share, among = plan.split, set(free)
    found = groups_of(Dataset(root), share.by if share else "seed") if free else {}
    groups = {number: group for number, group in found.items() if number in among}
    if share is None:
        return split_by_seed({number: int(group) for number, group in groups.items()})
    if len(set(groups.values())) < 2:
        _log.warning("%s: all episodes are of one %s, and train", root, share.by)
        return free, []
    train, val = cut(groups, [1 - share.val_share, share.val_share])
    return train, val
