"""Merge trajectory files of one episode each into one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import replacing, write_json
from robocas_ms3.demos.recordings.entries import one_seed, read_json
from robocas_ms3.demos.recordings.stored import copy_episode, open_episode, open_trajectory, readable, reserved

_MARGIN = 4096  # bytes an episode may need in a file of many beyond those of its own


def merge(shards: list[Path], out: Path) -> None:
    """Merge trajectory files into one, episodes numbered in the order given; unknown keys of the JSON are kept.

    The file is synced to disk before it gets its name, so a power cut leaves no half file.
    """
    merged: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    sizes = [shard.stat().st_size for shard in shards]
    with replacing(out, sync=True) as tmp:
        with reserved(tmp, sum(sizes) + _MARGIN * (1 + len(sizes))) as target:
            for shard in shards:
                data = read_json(shard)
                merged = merged or {key: value for key, value in data.items() if key != "episodes"}
                with open_trajectory(shard) as source:
                    for episode in data["episodes"]:
                        number = len(episodes)
                        copy_episode(source, episode["episode_id"], target, number)
                        episodes.append({**episode, "episode_id": number})
        # the JSON first: an HDF5 file that is there always has its JSON
        write_json(out.with_suffix(".json"), {**merged, "episodes": episodes}, sync=True)


def damage_of(path: Path, seeds: Sequence[int]) -> str:
    """Return what is wrong with a merged file that must hold these seeds in order, by its metadata; empty: nothing."""
    try:
        with open_trajectory(path) as file:
            said = read_json(path)["episodes"]
            found = [one_seed(episode.get("episode_seed")) for episode in said]
            if found != list(seeds) or len(file) != len(found):
                raise DatasetError("other episodes", expected=len(seeds), found=f"{len(found)}, {len(file)} as HDF5")
            for episode in said:
                where = f"traj_{episode['episode_id']}"
                group: Any = open_episode(file, episode["episode_id"])
                with readable(where):
                    group.visititems(lambda *_: None)
                    steps = len(group["actions"])
                if steps != episode.get("elapsed_steps", steps):
                    expected = f"{episode['elapsed_steps']} actions"
                    raise DatasetError("this episode is damaged", where=where, expected=expected, found=steps)
    except DatasetError as error:
        return str(error)
    return ""
