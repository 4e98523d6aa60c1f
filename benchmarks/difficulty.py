"""Measure the cost of the difficulty of scenes, alone on the machine; print JSON.

python benchmarks/difficulty.py --config search_table_stacked --scenes 20

JSON keys:
  config                task configuration
  grasp_attempts        number of attempts to grasp the target
  scenes                number of measured scenes
  cpu_seconds           mean, median and maximum of the CPU seconds per scene, with all forked processes
  simulated_removals    mean and maximum of the simulated removals per scene
  removals              number of scenes by smallest number of removals; null: no sequence was found
  incomplete            number of scenes whose search ended early
"""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import dataclass

import numpy as np
import tyro

from robocas_ms3.core.workers import hide_cuda, use_one_torch_thread


@dataclass
class Benchmark:
    config: str = "search_table_stacked"
    """Task configuration."""
    seed: int = 985100
    """Seed of the first scene."""
    scenes: int = 20
    """Number of scenes."""
    grasp_attempts: int = 3
    """Number of attempts, of which one must grasp the target."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    use_one_torch_thread()
    hide_cuda()
    from robocas_ms3.demos.difficulty.records import RemovalLimits
    from robocas_ms3.demos.difficulty.scene_difficulty import measure_difficulty
    from robocas_ms3.demos.generator import EpisodeGenerator
    from robocas_ms3.demos.settings import EpisodeSettings
    from robocas_ms3.scenes.config import load_task_config

    generator = EpisodeGenerator(EpisodeSettings(load_task_config(cfg.config).task, cfg.config, check_rate=0))
    seconds, scenes = [], []
    for seed in range(cfg.seed, cfg.seed + cfg.scenes):
        start = sum(os.times()[:4])
        scenes.append(measure_difficulty(generator, seed, RemovalLimits(grasp_attempts=cfg.grasp_attempts)))
        seconds.append(sum(os.times()[:4]) - start)
    generator.close()
    simulated = [scene.simulated_removals for scene in scenes]
    counts = Counter(scene.removals for scene in scenes)
    print(
        json.dumps(
            {
                "config": cfg.config,
                "grasp_attempts": cfg.grasp_attempts,
                "scenes": len(scenes),
                "cpu_seconds": [round(float(f(seconds)), 1) for f in (np.mean, np.median, np.max)],
                "simulated_removals": [round(float(f(simulated)), 1) for f in (np.mean, np.max)],
                "removals": {json.dumps(count): number for count, number in counts.items()},
                "incomplete": sum(not scene.complete for scene in scenes),
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
