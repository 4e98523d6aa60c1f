"""Measure what recorded candidates of decisions cost, without rendering; print JSON.

python benchmarks/candidates.py pick_table_scattered search_table_stacked --seeds 60000:60005

Each seed is recorded twice, with and without candidates. CPU seconds include forked processes. JSON keys, per task
configuration:
  episodes, decisions, candidates   numbers of recorded episodes, decisions and candidates
  cpu_seconds_without, cpu_seconds  CPU time per episode without and with candidates, s
  cpu_seconds_per_decision, cpu_seconds_per_candidate   additional CPU time, s
  candidates_per_hour               candidates per hour on two cores, with the time of the episodes
  mb_per_1000_decisions             size of candidates.h5 in MB
  same_episodes                     whether the episodes with and without candidates are equal
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from robocas_ms3.demos import EpisodeSettings
from robocas_ms3.demos.candidates.candidates_file import CandidateFile, merge_candidates
from robocas_ms3.demos.candidates.records import candidates_file_name
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.scenes.config import load_task_config


@dataclass
class Args:
    configs: Annotated[tuple[str, ...], tyro.conf.Positional] = ("pick_table_scattered",)
    """Task configurations."""
    seeds: str = "60000:60005"
    """Range of seeds, FIRST:END without END."""
    candidates: int = 16
    """Number of candidates per decision."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    first, end = map(int, args.seeds.split(":"))
    print(
        json.dumps({config: measure(config, range(first, end), args.candidates) for config in args.configs}, indent=2)
    )


def measure(config: str, seeds: range, count: int) -> dict[str, Any]:
    """Record the seeds with and without candidates, and return the JSON values of a configuration."""
    plain = EpisodeSettings(load_task_config(config).task, config)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        without = record(plain, seeds, out / "without")
        recorded = record(replace(plain, record_candidates=True, candidates=count), seeds, out / "with")
        names = [path.stem for path in sorted((out / "without").glob("*.h5"))]
        same = all((out / "without" / f"{n}.h5").read_bytes() == (out / "with" / f"{n}.h5").read_bytes() for n in names)
        merged = out / "candidates.h5"
        merge_candidates([out / "with" / candidates_file_name(name) for name in names], merged)
        file, size = CandidateFile(merged), merged.stat().st_size
    decisions, candidates = len(file), len(file.candidates["primitive"])
    return {
        "episodes": len(names),
        "decisions": decisions,
        "candidates": candidates,
        "cpu_seconds_without": round(without / len(seeds), 2),
        "cpu_seconds": round(recorded / len(seeds), 2),
        "cpu_seconds_per_decision": round((recorded - without) / decisions, 2),
        "cpu_seconds_per_candidate": round((recorded - without) / candidates, 3),
        "candidates_per_hour": round(2 * 3600 * candidates / recorded),
        "mb_per_1000_decisions": round(size / 1e6 / decisions * 1000, 1),
        "same_episodes": same,
    }


def record(settings: EpisodeSettings, seeds: range, folder: Path) -> float:
    """Record the episodes of some seeds to a folder; return the CPU time in s, without that of the start."""
    folder.mkdir()
    generator = EpisodeGenerator(settings)
    start = sum(os.times()[:4])
    for seed in seeds:
        generator.generate(seed, folder, str(seed))
    seconds = sum(os.times()[:4]) - start
    generator.close()
    return seconds


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
