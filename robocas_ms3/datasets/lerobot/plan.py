"""What a conversion to LeRobot does: settings, episodes, split. Kept beside its parts, and in the end in ``meta``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.outputs import check_same, is_taken
from robocas_ms3.core.strict import parse
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.lerobot.records import ConversionRecord
from robocas_ms3.datasets.lerobot.schema import CONVERSION_FILE, INFO_FILE
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.datasets.writing.inputs import ConversionInput
from robocas_ms3.datasets.writing.plan import LEFT_OUT, check_versions
from robocas_ms3.demos.recordings.versions import versions

PARTS = ".parts"
"""Folder of the episodes done so far; gone when the dataset is there."""
PLAN = "plan.json"


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


def check_resume(out: Path, plan: dict[str, Any]) -> None:
    """Go on with the same conversion only.

    Raises:
        DatasetError: another one was begun in ``out``, or something else is there.
    """
    if not is_taken(out):
        return
    path = out / CONVERSION_FILE if (out / INFO_FILE).is_file() else out / PARTS / PLAN
    try:
        before = load_json(path)
    except (OSError, ValueError) as error:
        if (out / PARTS).is_dir() and not any((out / PARTS).glob("episode_*")):
            return  # killed before it wrote what it was to do
        what = "can't resume: no conversion to LeRobot was begun here"
        raise DatasetError(what, where=path, fix="Pass --overwrite.") from error
    parse(ConversionRecord, before, DatasetError, where=path)
    check_same(
        before.get("settings", {}),
        plan["settings"],
        "can't resume with other settings",
        where=path,
        fix="Pass --overwrite, or the settings of before.",
        error=DatasetError,
    )
    check_versions(path, before, "resume", "Install those, or pass --overwrite.")
    if not _are_same(before, plan):
        raise DatasetError(
            "can't resume: these episodes are not what was begun here",
            where=path,
            expected=f"{count_of(len(before.get('episodes', [])), 'episode')}",
            found=f"{len(plan['episodes'])}",
            fix="Pass --overwrite to begin again.",
        )


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
