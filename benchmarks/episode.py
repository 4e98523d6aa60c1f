"""Measure the cost and the quality of demonstrations, without rendering; print JSON.

python benchmarks/episode.py pick_table_scattered search_table_stacked --seeds 60000:60020

A line with the measurements of each seed goes to stderr. JSON keys, per task configuration:
  seeds, success, lost    number of seeds, success rate, seeds without a demonstration
  cpu_seconds, cpu_seconds_median   mean and median of the CPU time per seed in seconds
  cpu_seconds_by_part     mean CPU time of each part of the generation in seconds
  physx_cpu_seconds       mean CPU time of bare PhysX for the same actions in seconds
  over_physx              CPU time of the successful seeds as a factor of bare PhysX
  mean_length_s, mean_attempts   mean length of a demonstration in seconds, mean number of attempts per seed
  failures                "stage: reason" -> number of failed attempts
  facts                   mean of each fact that is recorded about an episode
  clean_success           success rate of the 7-D actions of a dataset in open loop, without noise
  noisy_success           success rate of these actions with noise
  peak_mb, peak_mb_with_branches   peak memory of this process; with --memory, of this process and forked processes
  rss_mb                  seed -> memory of this process after the seed in MB
"""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from robocas_ms3.demos import EpisodeSettings
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.recordings.motion import Motion, sample_states, sample_stride
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_trajectory
from robocas_ms3.planning.action_noise import draw_noise
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.registry import PANDA
from robocas_ms3.scenes.config import load_task_config

FRESH = 1000  # first number of the noise seeds here; the checks during generation use smaller ones


@dataclass
class Args:
    configs: Annotated[tuple[str, ...], tyro.conf.Positional] = ("pick_table_scattered",)
    """Task configurations."""
    seeds: str = "60000:60020"
    """Range of seeds, FIRST:END without END."""
    pack: str = "builtin"
    """Object pack."""
    draws: int = 5
    """Number of noise checks per episode."""
    noise: tuple[float, float] = (0.5, 0.2)
    """Standard deviations of the noise per component of each action, in mm and degrees."""
    jobs: int = 1
    """Number of processes. To compare times, use 1 on an idle machine."""
    fork: bool = True
    """Use forked processes to return to the state before a failed decision."""
    memory: bool = False
    """Sample the memory (PSS) of this process and of forked processes; this takes time."""


@dataclass
class Seed:
    """Measurements of one seed."""

    seed: int
    success: bool
    steps: int
    attempts: int
    cpu: float
    parts: dict[str, float]
    failures: list[str]
    rss_mb: int
    all_mb: int = 0
    physx: float = 0.0
    facts: dict[str, int] = field(default_factory=dict)
    clean: bool = False
    noisy: int = 0


def main(args: Args) -> None:
    report = {}
    for config in args.configs:
        first, end = map(int, args.seeds.split(":"))
        shares = [list(range(first, end))[job :: args.jobs] for job in range(args.jobs)]
        if args.jobs == 1:
            found = run_seeds(args, config, shares[0])
        else:
            with multiprocessing.get_context("spawn").Pool(args.jobs) as pool:
                parts = pool.starmap(run_seeds, [(args, config, share) for share in shares])
            found = sorted((seed for part in parts for seed in part), key=lambda seed: seed.seed)
        report[config] = summarise(found, args)
    print(json.dumps(report, indent=2))


def run_seeds(args: Args, config: str, seeds: list[int]) -> list[Seed]:
    torch.set_num_threads(1)  # as `robocas generate` does
    settings = EpisodeSettings(load_task_config(config).task, config, args.pack)
    generator = EpisodeGenerator(settings, fork=args.fork)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        generator.generate(seeds[0] - 1, Path(folder), "warm")  # loads packs and starts planners
        for seed in seeds:
            before = read_cpu_seconds()
            with sample_memory(args.memory) as memory:
                result = generator.generate(seed, Path(folder), str(seed))
            spent = read_cpu_seconds() - before
            parts = {name: round(value, 3) for name, value in asdict(result.seconds).items()}
            failures = [f"{failure.stage}: {failure.reason}" for failure in result.failures]
            found.append(
                Seed(
                    seed, result.success, result.steps, result.attempts, round(spent, 3), parts, failures, read_rss_mb()
                )
            )
            found[-1].all_mb = max(memory, default=0)
            if result.success:
                replay_actions(found[-1], generator, Path(folder) / f"{seed}.h5", args)
            print(json.dumps(asdict(found[-1])), file=sys.stderr, flush=True)
    generator.close()
    return found


def read_cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its finished children."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in spent)


def read_rss_mb() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 2**20


@contextmanager
def sample_memory(wanted: bool) -> Iterator[list[int]]:
    """Sample the memory in MB (PSS) of this process and its branches twice per second."""
    samples: list[int] = []
    over = threading.Event()

    def sample() -> None:
        while not over.wait(0.5):
            samples.append(sum(map(read_pss_kb, list_process_tree(os.getpid()))) // 1024)

    thread = threading.Thread(target=sample)
    if wanted:
        thread.start()
    try:
        yield samples
    finally:
        over.set()
        if wanted:
            thread.join()


def list_process_tree(pid: int) -> list[int]:
    """Return the ids of a process and all its descendants."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(member for child in children for member in list_process_tree(int(child)))]


def read_pss_kb(pid: int) -> int:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0)


def replay_actions(found: Seed, generator: EpisodeGenerator, path: Path, args: Args) -> None:
    """Replay the recorded actions in bare PhysX, and the 7-D actions of the episode in open loop."""
    with open_trajectory(path) as file:
        group: Any = file["traj_0"]
        actions = np.array(group["actions"])
        states = np.array(group["env_states"]["articulations"][MOBILE_PANDA.uid])
    found.facts = json.loads(path.with_suffix(".json").read_text())["episodes"][0]["robocas"]["facts"]
    found.physx = round(measure_bare_physx(generator, found.seed, actions), 3)
    if not generator.open_loop_envs:
        return
    world = generator.open_loop_envs[0]
    stride = sample_stride(generator.settings.control_freq, world.rate_hz)
    own = (
        Motion.from_states(PANDA, states, actions[:, 7], sample_states(len(actions), stride))
        .actions[:-1]
        .astype(np.float64)
    )
    for draw in range(-1, args.draws):
        world.reset(found.seed)
        rng = np.random.default_rng([found.seed, FRESH + draw + 1])
        success = world.replay(own if draw < 0 else own + draw_noise(rng, len(own), *args.noise)).success
        if draw < 0:
            found.clean = success
        else:
            found.noisy += success


def measure_bare_physx(generator: EpisodeGenerator, seed: int, actions: np.ndarray) -> float:
    """Return the CPU seconds that PhysX takes for the actions of an episode."""
    generator.env.reset(seed=seed)
    env: Any = generator.env.unwrapped
    substeps, spent = env._sim_steps_per_control, 0.0
    for action in torch.as_tensor(actions):
        env.agent.set_action(action[None])
        for _ in range(substeps):
            env.agent.before_simulation_step()
            start = time.process_time()
            env.scene.px.step()
            spent += time.process_time() - start
    return spent


def summarise(found: list[Seed], args: Args) -> dict[str, Any]:
    good = [seed for seed in found if seed.success]
    mean = lambda values: round(float(np.mean(list(values) or [np.nan])), 3)  # noqa: E731
    return {
        "seeds": len(found),
        "success": len(good) / len(found),
        "lost": [seed.seed for seed in found if not seed.success],
        "cpu_seconds": mean(seed.cpu for seed in found),
        "cpu_seconds_median": round(float(np.median([seed.cpu for seed in found])), 3),
        "cpu_seconds_by_part": {part: mean(seed.parts[part] for seed in found) for part in found[0].parts},
        "physx_cpu_seconds": mean(seed.physx for seed in good),
        "over_physx": round(sum(seed.cpu for seed in good) / max(1e-9, sum(seed.physx for seed in good)), 2),
        "mean_length_s": mean(seed.steps / 20 for seed in good),
        "mean_attempts": mean(seed.attempts for seed in found),
        "failures": dict(Counter(failure for seed in found for failure in seed.failures).most_common()),
        "facts": {key: mean(seed.facts.get(key, 0) for seed in good) for key in (good[0].facts if good else ())},
        "clean_success": mean(seed.clean for seed in good),
        "noisy_success": mean(seed.noisy / max(1, args.draws) for seed in good),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "peak_mb_with_branches": max(seed.all_mb for seed in found),
        "rss_mb": {seed.seed: seed.rss_mb for seed in found[:: max(1, len(found) // 10)]},
    }


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
