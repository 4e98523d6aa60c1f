"""What a conversion to LeRobot does: settings, episodes, split. Kept beside its parts, and in the end in ``meta``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from robocas_ms3.core.errors import DatasetError, OutputExistsError
from robocas_ms3.core.outputs import FolderKind, OutputFolder
from robocas_ms3.core.strict import parse
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.lerobot.records import ConversionRecord
from robocas_ms3.datasets.lerobot.schema import CONVERSION_FILE, INFO_FILE
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.datasets.writing.inputs import ConversionInput
from robocas_ms3.datasets.writing.output import with_versions
from robocas_ms3.datasets.writing.plan import LEFT_OUT
from robocas_ms3.demos.recordings.entries import versions

PARTS = ".parts"
"""Folder of the episodes done so far; gone when the dataset is there."""
PLAN = "plan.json"
OUTPUT = FolderKind(
    "robocas convert --to lerobot",
    (f"{PARTS}/{PLAN}", CONVERSION_FILE),
    "settings",
    marks=(INFO_FILE, PARTS),
    upgrade=with_versions,
)


def plan_of(given: ConversionInput, fps: int, codec: str, version: str) -> dict[str, Any]:
    """Return what a conversion will do: settings, episodes, split."""
    entries, pictures = given.entries(), given.pictures
    place = {entry["source"]: i for i, entry in enumerate(entries)}
    before_train, before_val = ([place[n] for n in side if n in place] for side in given.source.settled_split())
    seeds = {i: i if e["seed"] is None else _seed(e["seed"]) for i, e in enumerate(entries)}
    train, val = split_by_seed(seeds, (before_train, before_val))
    plan = {
        "format": "lerobot",
        "made_with": versions(),
        "settings": {
            "lerobot_version": version,
            "rate_hz": fps,
            "cameras": list(pictures.cameras),
            "depth": pictures.depth,
            "codec": codec,
            "size": pictures.size,
        },
        "train_eps": train,
        "val_eps": val,
        "episodes": entries,
    }
    return json.loads(json.dumps(plan))


def _seed(seed: Any) -> int:
    return int(seed[0] if isinstance(seed, list) else seed)


def only(plan: Mapping[str, Any], indices: Sequence[int], reasons: Mapping[int, str]) -> dict[str, Any]:
    """The same with some of the episodes; the others are told under ``left_out``.

    Args:
        plan: it.
        indices: of those that stay, in order.
        reasons: why the others don't, by index.
    """
    place = {index: new for new, index in enumerate(indices)}
    sides = {side: [place[i] for i in plan[side] if i in place] for side in ("train_eps", "val_eps")}
    episodes = plan["episodes"]
    left_out = [{**entry, "why": reasons[i]} for i, entry in enumerate(episodes) if i not in place]
    return {**plan, **sides, "episodes": [episodes[index] for index in indices], LEFT_OUT: left_out}


def check_episodes(output: OutputFolder, plan: Mapping[str, Any]) -> None:
    """Check that a dataset that is continued is of the same episodes.

    Raises:
        OutputExistsError: it is of others.
        DatasetError: its record is damaged.
    """
    if output.recorded is None:
        return
    parse(ConversionRecord, output.recorded, DatasetError, where=output.path)
    if not _are_same(output.recorded, plan):
        recorded = output.recorded.get("episodes", [])
        what, expected = "a dataset of other episodes", count_of(len(recorded), "episode")
        found, fix = f"{len(plan['episodes'])}", "Choose another folder, or pass --overwrite to start again."
        raise OutputExistsError(what, where=output.path, expected=expected, found=found, fix=fix)


def _are_same(before: Mapping[str, Any], plan: Mapping[str, Any]) -> bool:
    """Whether a plan is of the same episodes; one that could not be read then may have been mended."""
    listed, now = [*before.get("episodes", []), *before.get(LEFT_OUT, [])], plan["episodes"]
    listed = sorted(listed, key=lambda entry: entry.get("source") or 0)
    return len(listed) == len(now) and all(map(_is_same, listed, now))


def _is_same(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    keys = ["source", "trajectory", "trajectory_episode", "seed"]
    if before.get("recording") is not None:
        keys.append("recording")
    return all(before.get(key) == now[key] for key in keys)
