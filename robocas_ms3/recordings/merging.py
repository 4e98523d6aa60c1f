"""Merge trajectory files of one episode each into one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robocas_ms3.files import replacing, write_json
from robocas_ms3.recordings.entries import read_json
from robocas_ms3.recordings.stored import copy_episode, open_trajectory
from robocas_ms3.recordings.whole import reserved

_MARGIN = 4096  # bytes an episode may need in a file of many beyond those of its own


def merge(shards: list[Path], out: Path) -> None:
    """Merge trajectory files into one, episodes numbered in the order given; unknown keys of the JSON are kept.

    Args:
        shards: HDF5 files, each with its JSON beside it.
        out: HDF5 file to write; its JSON is written beside it.

    Raises:
        DatasetError: a file can't be read.
    """
    merged: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    sizes = [shard.stat().st_size for shard in shards]
    with replacing(out) as tmp:
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
        write_json(out.with_suffix(".json"), {**merged, "episodes": episodes})
