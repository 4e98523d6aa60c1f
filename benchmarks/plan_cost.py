"""Estimate the cost of a plan from a few episodes per plan part; print JSON.

python benchmarks/plan_cost.py paper --episodes 4 --seed 0

The benchmark records and renders the same number of episodes of each plan part, and extrapolates. JSON keys:
  plan                       name or file of the plan
  measured_episodes_a_part   number of measured episodes per plan part
  measured_minutes           wall-clock time of the measurement in minutes
  parts                      per plan part: record_cpu_seconds and render_cpu_seconds (CPU seconds per episode),
                             megabytes (size per episode), episodes (number in the plan), cpu_hours (of the part)
  cpu_hours, gigabytes       cost of the whole plan
  hours                      number of cores -> wall-clock hours of the whole plan
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
import yaml

from robocas_ms3.plans.load import load_plan
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.status import PartStatus, read_status


@dataclass
class Benchmark:
    plan: Annotated[str, tyro.conf.Positional] = "paper"
    """Name of a bundled plan, or a YAML file."""
    episodes: int = 4
    """Number of episodes of each part."""
    seed: int = 0
    """First seed of all parts; choose unused seeds."""
    jobs: int = os.cpu_count() or 1
    """Number of parallel jobs: one per core, as for the plan."""
    cores: tuple[int, ...] = (2, 64)
    """Numbers of cores for which to print the hours."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    plan = load_plan(cfg.plan)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "sample.yaml", Path(folder) / "out"
        path.write_text(yaml.safe_dump(make_sample_plan(plan, cfg)), encoding="utf-8")
        command = [sys.executable, "-W", "ignore", "robocas_cli.py", "plan", "run", str(path), "--out", str(out)]
        start = time.monotonic()
        subprocess.run([*command, "--jobs", str(cfg.jobs)], check=True, stdout=subprocess.DEVNULL)
        print(json.dumps(make_report(plan, cfg, read_status(out).parts, time.monotonic() - start), indent=2))


def make_sample_plan(plan: Plan, cfg: Benchmark) -> dict[str, Any]:
    """Return the plan with fewer episodes, work units of one episode, and no embeddings (their cost is negligible)."""
    sample = plan.model_dump(mode="json", exclude_none=True)
    for number, part in enumerate(sample["parts"]):
        part |= {"episodes": cfg.episodes, "seed": cfg.seed + 1000 * number}
    return {**sample, "stages": ["demonstrations", "datasets"], "formats": ["robocas"], "embeddings": False, "block": 1}


def make_report(plan: Plan, cfg: Benchmark, parts: list[PartStatus], wall: float) -> dict[str, Any]:
    """Return the costs and the measurements that they follow from."""
    rows = {}
    for part, measured in zip(plan.parts, parts, strict=True):
        each = measured.record_seconds + measured.render_seconds
        rows[f"{part.name}"] = {
            "record_cpu_seconds": measured.record_seconds,
            "render_cpu_seconds": measured.render_seconds,
            "megabytes": round(measured.bytes / 1e6 / cfg.episodes, 1),
            "episodes": part.episodes,
            "cpu_hours": round(part.episodes * each / 3600, 2),
        }
    hours = sum(row["cpu_hours"] for row in rows.values())
    return {
        "plan": cfg.plan,
        "measured_episodes_a_part": cfg.episodes,
        "measured_minutes": round(wall / 60, 1),
        "parts": rows,
        "cpu_hours": round(hours, 1),
        "gigabytes": round(sum(row["megabytes"] * row["episodes"] for row in rows.values()) / 1000),
        "hours": {f"{cores} cores": round(hours / cores, 2) for cores in cfg.cores},
    }


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
