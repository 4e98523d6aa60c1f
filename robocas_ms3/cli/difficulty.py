"""``robocas difficulty``: measure how visible and accessible the target is in the scenes of a configuration."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import CORES, Jobs, Maybe, Overrides, PackName, resumable
from robocas_ms3.core.text import format_count


@dataclass
class Difficulty:
    """Measure the difficulty of scenes: visible fraction, free grasps and gaps of the target, and removals.

    The number of removals is the smallest number of objects to remove before the target can be grasped. It is found by
    simulating all sequences of removals with the skills of the scripted policy. After an interruption, the same command
    continues. Results: DIR/scenes.jsonl. The exit status is 1 if a seed has no scene.

    Example: robocas difficulty search_table_stacked --seeds 0:20 --out difficulty/search
    """

    config: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")]
    """Bundled task configuration by name, or a YAML file."""
    set: Overrides = ()
    """Set a key of the configuration, such as `--set objects.count=12`; repeatable (docs/configuration.md)."""
    pack: PackName = "builtin"
    """Name or folder of the object pack."""
    seeds: Annotated[str, tyro.conf.arg(metavar="FIRST:END")] = "0:10"
    """Range of seeds, without END."""
    max_removals: int = 3
    """Largest number of removals to search."""
    max_simulated: int = 40
    """Number of simulated removals per scene after which no other sequence is started."""
    jobs: Jobs = CORES
    """Number of processes; the results do not depend on it. Default: one per CPU core."""
    out: Maybe[Path] = None
    """Output folder. Default: difficulty/CONFIG."""
    overwrite: bool = False
    """Delete earlier results and start again. Default: continue."""


@resumable
def main(cfg: Difficulty) -> int:
    from robocas_ms3.cli.layouts import parse_seeds
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line, print_table
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.demos.difficulty.difficulty_file import DifficultySettings, measure_seeds, read_difficulties
    from robocas_ms3.demos.difficulty.records import RemovalLimits
    from robocas_ms3.scenes.config import load_task_config

    for name, least in (("jobs", 1), ("max_removals", 0), ("max_simulated", 1)):
        check_number(f"--{name.replace('_', '-')}", getattr(cfg, name), least)
    seeds, config = parse_seeds(cfg.seeds, "--seeds"), load_task_config(cfg.config, set_options=cfg.set)
    limits = RemovalLimits(cfg.max_removals, cfg.max_simulated)
    settings = DifficultySettings(config.task, config.model_dump(mode="json"), cfg.pack, limits=limits)
    out = cfg.out or Path("difficulty") / Path(cfg.config).stem
    problems = 0
    with ProgressBar("scenes measured") as bar:
        results = measure_seeds(
            settings,
            seeds,
            out,
            jobs=cfg.jobs,
            overwrite=cfg.overwrite,
            on_start=lambda measured: bar.start(len(seeds), measured),
        )
        for result in results:
            if result.problem:
                problems += 1
                bar.add_note(f"seed {result.seed}: {result.problem}")
            else:
                bar.advance()
    scenes = [scene for scene in read_difficulties(out) if scene.seed in seeds]
    counts = Counter("none found" if scene.removals is None else str(scene.removals) for scene in scenes)
    print_table(("removals", "scenes"), [(name, str(counts[name])) for name in sorted(counts)])
    if cut := sum(not scene.complete for scene in scenes):
        print_line(f"note: the search of {format_count(cut, 'scene')} ended early (--max-simulated)")
    print_line(f"{format_count(len(scenes), 'scene')} measured, {format_count(problems, 'seed')} without a scene")
    print_line(f"wrote {out / 'scenes.jsonl'}")
    return 1 if problems else 0
