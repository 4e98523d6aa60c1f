"""Measure the difficulty of many scenes, and choose scenes for a protocol that are evenly spread over the difficulty.

    python scripts/choose_scenes.py scripts/clutter_scale_candidates.yaml --scenes 300 --out difficulty/scale

SOURCE is a protocol source (docs/evaluation.md). The seeds of its parts are those of the measured scenes. The script
writes OUT/NAME with the difficulties of each part, OUT/source.yaml with the chosen seeds, and OUT/difficulty.jsonl with
their difficulties in the order of the episodes. An interrupted run is continued.

The scenes are grouped by task and number of removals. All groups get the same number of scenes if they have enough;
within a group, scenes are chosen evenly over the visible fraction of the target.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
import yaml

from robocas_ms3.cli.progress import ProgressBar
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.demos.difficulty.difficulty_file import DifficultySettings, measure_seeds, read_difficulties
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.freeze import ProtocolPart, read_protocol_source

MOST_REMOVALS = 3  # scenes with more removals, or without a solution, are in the same group
Scene = tuple[str, SceneDifficulty]  # name of its part, difficulty


@dataclass
class Options:
    """Options of the script."""

    source: tyro.conf.Positional[Path]
    """Protocol source."""
    out: Path
    """Output folder."""
    scenes: int = 300
    """Number of scenes to choose."""
    min_removals: int = 0
    """Smallest number of removals of the chosen scenes; 1 for questions about the order of removals."""
    jobs: int = os.cpu_count() or 1
    """Number of processes."""


def main(options: Options) -> None:
    source = read_protocol_source(options.source)
    groups: dict[tuple[str, int], list[Scene]] = defaultdict(list)
    for part in source.parts:
        task = part.load_config().task
        for scene in measure_part(part, str(source.rules.get("pack", "builtin")), options):
            removals = MOST_REMOVALS if scene.removals is None else min(scene.removals, MOST_REMOVALS)
            if removals >= options.min_removals:
                groups[task, removals].append((part.file_stem, scene))
    chosen = choose_evenly(groups, options.scenes)
    order = {part.file_stem: number for number, part in enumerate(source.parts)}
    chosen.sort(key=lambda scene: (order[scene[0]], scene[1].seed))
    parts = []
    for part in source.parts:
        seeds = [scene.seed for name, scene in chosen if name == part.file_stem]
        if seeds:
            parts.append({**part.model_dump(exclude_defaults=True, exclude={"count", "first_seed"}), "seeds": seeds})
    content = {**source.model_dump(exclude={"lists"}), "parts": parts}
    (options.out / "source.yaml").write_text(yaml.safe_dump(content, sort_keys=False, width=120), encoding="utf-8")
    JsonLinesFile(options.out / "difficulty.jsonl", SceneDifficulty).rewrite(scene for _, scene in chosen)
    for (task, removals), scenes in sorted(groups.items()):
        name = f"{removals} or more" if removals == MOST_REMOVALS else str(removals)
        print(f"{task}, {name} removals: {sum(scene in scenes for scene in chosen)} of {len(scenes)} scenes")


def measure_part(part: ProtocolPart, pack: str, options: Options) -> list[SceneDifficulty]:
    config = part.load_config()
    settings = DifficultySettings(config.task, config.model_dump(mode="json"), pack)
    seeds = part.seeds or range(part.first_seed, part.first_seed + part.count)
    out = options.out / part.file_stem
    with ProgressBar(f"scenes of {part.file_stem} measured") as bar:
        for result in measure_seeds(
            settings, seeds, out, jobs=options.jobs, on_start=lambda count: bar.start(len(seeds), count)
        ):
            if result.problem:
                bar.add_note(f"seed {result.seed}: {result.problem}")
            bar.advance()
    return [scene for scene in read_difficulties(out) if scene.seed in seeds]


def choose_evenly(groups: Mapping[tuple[str, int], Sequence[Scene]], count: int) -> list[Scene]:
    """Choose up to ``count`` scenes, as many of each group as possible, and evenly over the visible fraction."""
    sizes = dict.fromkeys(groups, 0)
    for _ in range(min(count, sum(map(len, groups.values())))):
        smallest = min((key for key in groups if sizes[key] < len(groups[key])), key=lambda key: (sizes[key], key))
        sizes[smallest] += 1
    chosen: list[Scene] = []
    for key, scenes in groups.items():
        ordered = sorted(scenes, key=lambda scene: (scene[1].visible_fraction, scene[1].seed))
        positions = np.linspace(0, len(ordered) - 1, sizes[key]).round().astype(int)
        chosen += [ordered[position] for position in positions]
    return chosen


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
