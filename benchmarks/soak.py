"""Run a plan for some time and interrupt it with Ctrl-C; print JSON.

python benchmarks/soak.py --minutes 60 --jobs 2

The plan is longer than the time. JSON keys:
  minutes, jobs                          duration until Ctrl-C, number of parallel jobs
  episodes, seeds                        task -> number of recorded episodes, and of seeds that were tried
  episodes_per_hour, recent_episodes_per_hour   rate over the whole time, and the rate that `robocas plan status` prints
  cpu_seconds_per_episode                task -> CPU seconds per recorded episode
  wall_seconds_times_jobs_per_episode    wall-clock seconds times number of jobs per recorded episode
  steps_per_episode, megabytes_per_episode   task -> mean number of steps, and of MB on the disk
  crashes, ctrl_c_seconds                number of crashed workers, seconds from Ctrl-C to the end of the plan
  processes                              one entry per worker process: minutes (lifetime), first_mb, last_mb and peak_mb
                                         (memory), growth_mb_per_500_episodes (memory growth from the third minute on)
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tyro
import yaml

from robocas_ms3.plans.folder import Outcome, read_plan
from robocas_ms3.plans.progress import PlanProgress
from robocas_ms3.plans.status import read_status

LOOK = 5.0  # s between two samples of memory


@dataclass
class Benchmark:
    minutes: float = 60.0
    """Minutes until Ctrl-C."""
    jobs: int = 2
    """Number of parallel jobs."""
    tasks: tuple[str, ...] = ("pick", "select", "search")
    """Tasks, in turns."""
    turn: int = 10
    """Episodes of a task per turn."""
    images: bool = True
    """Render the episodes: three cameras, RGB-D, 5 Hz."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the images in pixels; small images take little time, and memory grows with the scenes."""
    seed: int = 0
    """First seed; choose unused seeds."""


@dataclass
class Memory:
    """Memory samples of one process."""

    at: list[float] = field(default_factory=list)
    megabytes: list[float] = field(default_factory=list)


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    with tempfile.TemporaryDirectory() as folder:
        plan, out = Path(folder) / "soak.yaml", Path(folder) / "out"
        plan.write_text(yaml.safe_dump(make_plan(cfg)), encoding="utf-8")
        words = ["plan", "run", str(plan), "--out", str(out), "--jobs", str(cfg.jobs)]
        start = time.monotonic()
        process = subprocess.Popen([sys.executable, "-W", "ignore", "robocas_cli.py", *words], start_new_session=True)
        try:
            memory = sample_memory(process, start + 60 * cfg.minutes)
            wall = time.monotonic() - start
            os.killpg(process.pid, signal.SIGINT)
            interrupted = time.monotonic()
            process.wait(60)
            ctrl_c = time.monotonic() - interrupted
        finally:
            process.kill()
        print(json.dumps(make_report(cfg, out, wall, ctrl_c, memory), indent=2))


def make_plan(cfg: Benchmark) -> dict[str, Any]:
    """Return a plan with the tasks in turns, longer than the time."""
    turns, apart = max(1, int(cfg.minutes * cfg.jobs)), max(1000, 10 * cfg.turn)
    parts = [
        {"task": task, "episodes": cfg.turn, "seed": cfg.seed + apart * turn, "name": f"{task}-{turn:04d}"}
        for turn in range(turns)
        for task in cfg.tasks
    ]
    stages = ["demonstrations", "datasets"] if cfg.images else ["demonstrations"]
    return {"parts": parts, "stages": stages, "images": {"size": list(cfg.size)}, "embeddings": False, "block": 1}


def sample_memory(process: subprocess.Popen[bytes], until: float) -> dict[int, Memory]:
    """Sample the memory of the processes of the run until a time, or until the run ends."""
    memory: dict[int, Memory] = defaultdict(Memory)
    runner = psutil.Process(process.pid)
    while time.monotonic() < until:
        if process.poll() is not None:
            raise SystemExit(f"the run ended before Ctrl-C: exit status {process.returncode}")
        for child in runner.children():
            try:
                memory[child.pid].megabytes.append(child.memory_info().rss / 2**20)
                memory[child.pid].at.append(time.monotonic())
            except psutil.Error:
                continue
        time.sleep(LOOK)
    return memory


def make_report(cfg: Benchmark, out: Path, wall: float, ctrl_c: float, memory: dict[int, Memory]) -> dict[str, Any]:
    """Return the measurements."""
    progress = PlanProgress(read_plan(out))
    found: dict[str, list[Outcome]] = defaultdict(list)
    for unit, outcomes in [*progress.done.items(), *progress.partial.items()]:
        found[progress.plan.part_name(unit.part).split("-")[0]] += outcomes
    good = {task: [one for one in made if one.success] for task, made in found.items()}
    cpu = {
        task: sum(one.record_seconds + one.render_seconds for one in made) / max(1, len(good[task]))
        for task, made in found.items()
    }
    episodes = sum(map(len, good.values()))
    return {
        "minutes": round(wall / 60, 1),
        "jobs": cfg.jobs,
        "episodes": {task: len(made) for task, made in good.items()},
        "seeds": {task: len(made) for task, made in found.items()},
        "episodes_per_hour": round(3600 * episodes / wall, 1),
        "recent_episodes_per_hour": read_status(out).episodes_per_hour,
        "cpu_seconds_per_episode": {task: round(seconds, 2) for task, seconds in cpu.items()},
        "wall_seconds_times_jobs_per_episode": round(wall * cfg.jobs / max(1, episodes), 2),
        "steps_per_episode": {
            task: round(sum(one.steps for one in made) / max(1, len(made))) for task, made in good.items()
        },
        "megabytes_per_episode": {
            task: round(sum(one.size for one in made) / 1e6 / max(1, len(made)), 2) for task, made in good.items()
        },
        "crashes": sum(len(one.crashes) for made in found.values() for one in made),
        "ctrl_c_seconds": round(ctrl_c, 2),
        "processes": [
            measure_growth(one, episodes / cfg.jobs / wall) for one in memory.values() if len(one.at) * LOOK > 60
        ],
    }


def measure_growth(memory: Memory, episodes_per_second: float) -> dict[str, float]:
    """Return the memory growth of a process from its third minute on; before, it loads its modules and packs."""
    at, megabytes = np.array(memory.at), np.array(memory.megabytes)
    later = at > at[0] + 120
    slope = float(np.polyfit(at[later], megabytes[later], 1)[0]) if later.sum() > 10 else float("nan")
    return {
        "minutes": round(float(at[-1] - at[0]) / 60, 1),
        "first_mb": round(float(megabytes[: max(1, len(megabytes) // 10)].mean())),
        "last_mb": round(float(megabytes[-max(1, len(megabytes) // 10) :].mean())),
        "peak_mb": round(float(megabytes.max())),
        "growth_mb_per_500_episodes": round(500 * slope / episodes_per_second, 1)
        if episodes_per_second
        else float("nan"),
    }


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
