"""Choose episodes of a protocol whose scenes are evenly spread over the difficulty, and write them as another protocol.

    robocas eval freeze scripts/clutter_scale_candidates.yaml --out candidates
    robocas difficulty --protocol candidates --out difficulty
    cp difficulty/difficulty.jsonl candidates/
    python scripts/choose_scenes.py candidates --scenes 300 --name mine --out protocols/mine

The episodes are grouped by task and number of removals (docs/difficulty.md). All groups get the same number of scenes
if they have enough; within a group, scenes are chosen evenly over the visible fraction of the target. The written
protocol has the frozen layouts of its episodes, and their difficulties. Run the script with .venv/bin/python.
"""

from __future__ import annotations

import shutil
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
import yaml

from robocas_ms3.core.documents import load_yaml
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.files import atomic_folder, make_folder
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import check_replaceable
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.bundled_protocols import RULES
from robocas_ms3.evaluation.protocol import (
    CONFIGS,
    EPISODES,
    LAYOUTS,
    TRAIN,
    LoadedProtocol,
    ProtocolEpisode,
    load_protocol,
)
from robocas_ms3.evaluation.scene_difficulties import DIFFICULTIES, read_difficulties_of

MOST_REMOVALS = 3  # scenes with more removals, or without a solution, are in the same group
Scene = tuple[ProtocolEpisode, SceneDifficulty]


@dataclass
class Options:
    """Options of the script."""

    protocol: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PROTOCOL")]
    """Protocol folder with difficulty.jsonl."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder of the new protocol."""
    name: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """Name of the new protocol."""
    description: str = ""
    """Description of the new protocol. Default: that of the old one."""
    scenes: Annotated[int, tyro.conf.arg(metavar="N")] = 300
    """Number of scenes to choose."""
    min_removals: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Smallest number of removals of the chosen scenes; 1 for questions about the order of removals.
    From 1 on, scenes in which no sequence of removals was found are left out too."""


def main(options: Options) -> None:
    check_replaceable(options.out)
    protocol = load_protocol(options.protocol)
    groups: dict[tuple[str, int], list[Scene]] = defaultdict(list)
    for episode, scene in zip(protocol.episodes, read_difficulties_of(protocol), strict=True):
        if options.min_removals and (scene.removals or 0) < options.min_removals:
            continue
        removals = MOST_REMOVALS if scene.removals is None else min(scene.removals, MOST_REMOVALS)
        groups[episode.task, removals].append((episode, scene))
    chosen = sorted(choose_evenly(groups, options.scenes), key=lambda scene: scene[0].episode)
    write_protocol(protocol, chosen, options)
    for (task, removals), scenes in sorted(groups.items()):
        name = f"{removals} or more removals, or none found" if removals == MOST_REMOVALS else f"removals: {removals}"
        print(f"{task}, {name}: {sum(scene in scenes for scene in chosen)} of {len(scenes)} scenes")


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


def write_protocol(protocol: LoadedProtocol, scenes: Sequence[Scene], options: Options) -> None:
    """Write a protocol with some of the episodes of another one, with their layouts and difficulties."""
    rules = load_yaml(protocol.folder / RULES) | {"name": options.name}
    rules |= {"description": options.description} if options.description else {}
    episodes = [episode.model_copy(update={"episode": number}) for number, (episode, _) in enumerate(scenes)]
    with atomic_folder(options.out) as tmp:
        if protocol.training_configs():
            shutil.copytree(protocol.folder / TRAIN, tmp / TRAIN)
        make_folder(tmp / LAYOUTS)
        make_folder(tmp / CONFIGS)
        for config in dict.fromkeys(episode.config for episode in episodes):
            shutil.copy(protocol.config_file(config), tmp / CONFIGS)
            records = np.load(protocol.layouts_file(config))
            seeds = [episode.seed for episode in episodes if episode.config == config]
            np.save(tmp / LAYOUTS / f"{config}.npy", records[np.isin(records["seed"], seeds)])
        lines = "".join(f"{episode.model_dump_json()}\n" for episode in episodes)
        (tmp / EPISODES).write_text(lines, encoding="utf-8")
        (tmp / RULES).write_text(yaml.safe_dump(rules, sort_keys=False, allow_unicode=True), encoding="utf-8")
        JsonLinesFile(tmp / DIFFICULTIES, SceneDifficulty).rewrite(scene for _, scene in scenes)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except RobocasError as error:
        sys.exit(f"error: {error}")
