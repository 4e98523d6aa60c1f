"""Measure resets to layouts in the layout cache, without images; print JSON.

python benchmarks/resets.py --seeds 60

The benchmark fills the layout cache, and then resets to each seed several times. JSON keys:
  config, objects, seeds   task configuration, number of objects per scene, number of seeds with a layout
  first_round_ms           times of the first reset to each seed, which reads objects from the pack
  later_rounds_ms          times of all later resets
Each of both times has wall (wall-clock time) and cpu (CPU time of the main thread): median, mean, p95 (95th percentile)
and max in ms.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro

from robocas_ms3.scenes.cache import LayoutCache, seed_pairs
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.tasks import TASKS


@dataclass
class Benchmark:
    config: str = "search_table_stacked"
    """Task configuration; the default has 15 objects."""
    pack: str = "builtin"
    """Object pack."""
    seeds: int = 60
    """Number of seeds, from 0 on."""
    rounds: int = 3
    """Resets to each seed, at least 2. The first one reads objects from the pack."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    torch.set_num_threads(1)  # as in generation; the tensors are small
    config = load_task_config(cfg.config)
    env = gym.make(TASKS[config.task].env_id, config=cfg.config, pack=cfg.pack, obs_mode="none", render_backend="none")
    base = env.unwrapped
    pairs = seed_pairs(range(cfg.seeds))
    failed = {pair for pair, problem in LayoutCache(base.model).fill(pairs) if problem}
    seeds = [seed for seed, _ in pairs if (seed, seed) not in failed]
    rounds = []
    for _ in range(cfg.rounds):
        rounds.append([])
        for seed in seeds:
            wall, cpu = time.perf_counter(), time.thread_time()
            env.reset(seed=seed)
            rounds[-1].append((time.perf_counter() - wall, time.thread_time() - cpu))
    report = {
        "config": cfg.config,
        "objects": len(base.objects),
        "seeds": len(seeds),
        "first_round_ms": _figures(rounds[:1]),
        "later_rounds_ms": _figures(rounds[1:]),
    }
    print(json.dumps(report, indent=2))


def _figures(rounds: list[list[tuple[float, float]]]) -> dict[str, dict[str, float]]:
    """Return statistics of the wall-clock time and of the CPU time of this thread, which depends less on other load."""
    figures = {}
    for name, seconds in zip(("wall", "cpu"), np.concatenate(rounds).T, strict=True):
        values = {"median": np.median(seconds), "mean": np.mean(seconds), "p95": np.percentile(seconds, 95)}
        figures[name] = {key: round(1000 * float(v), 1) for key, v in {**values, "max": np.max(seconds)}.items()}
    return figures


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
