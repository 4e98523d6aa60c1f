"""Training and validation episodes of a plan's dataset."""

from __future__ import annotations

import logging
from pathlib import Path

from robocas_ms3.datasets.manage.splitting import Share, cut, groups_of
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.split import SPLIT_RULE, split_by_seed
from robocas_ms3.plans.plan import Plan

Split = tuple[list[int], list[int]]
_log = logging.getLogger(__name__)


def rule_of(plan: Plan) -> str:
    """Return the rule in words, for ``conversion.json``."""
    rule = Share(plan.split.val_share, plan.split.by).rule if plan.split else SPLIT_RULE
    named = [f"{part.name}: {part.split}" for part in plan.parts if part.split]
    return "; ".join([*named, rule if len(named) < len(plan.parts) else ""]).removesuffix("; ")


def split_of(plan: Plan, root: Path) -> Split:
    """Return training and validation episodes; of the parts that name no split, by the plan's rule.

    Args:
        plan: the plan of the dataset.
        root: the dataset, with all episodes.

    Raises:
        DatasetError: an episode lacks its seed, target or task.
    """
    split: Split = ([], [])
    free: list[int] = []
    for number, part in enumerate(plan.parts):
        first = plan.first_episode(number)
        chosen = free if part.split is None else split[part.split == "val"]
        chosen += range(first, first + part.episodes)
    train, val = _by_rule(plan, root, free)
    return sorted([*split[0], *train]), sorted([*split[1], *val])


def _by_rule(plan: Plan, root: Path, free: list[int]) -> Split:
    config, among = plan.split, set(free)
    found = groups_of(Dataset(root), config.by if config else "seed") if free else {}
    groups = {number: group for number, group in found.items() if number in among}
    if config is None:
        return split_by_seed({number: int(group) for number, group in groups.items()})
    if len(set(groups.values())) < 2:
        _log.warning("%s: all episodes have one %s: they are for training", root, config.by)
        return free, []
    train, val = cut(groups, [1 - config.val_share, config.val_share])
    return train, val
