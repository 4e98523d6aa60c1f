"""Measure the overhead of the executor and of the files of a plan, with work units that only wait; print JSON.

python benchmarks/plan_overhead.py --units 10000 --workers 64

Each work unit has one seed and sleeps for a fixed time; no dataset is written. JSON keys:
  units, workers, cores   number of work units, worker processes, and cores of this machine
  seconds_a_unit          duration of a work unit in seconds
  units_per_second        finished work units per second while all workers are busy
  overhead_percent        by how much longer a work unit takes than its sleep
  wall_seconds            time from the start to the last finished work unit
  seconds_to_start        time until all workers have started
  runner_cpu_ms_a_unit    CPU time of the main process per work unit in ms
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from robocas_ms3.plans import worker
from robocas_ms3.plans.executors import LocalExecutor
from robocas_ms3.plans.folder import PlanFolder, SeedFiles, WorkUnit
from robocas_ms3.plans.plan import PartConfig, Plan
from robocas_ms3.plans.run import run_shard


@dataclass
class Benchmark:
    units: int = 10_000
    """Number of work units."""
    workers: int = 64
    """Number of worker processes."""
    seconds: float = 1.0
    """Seconds per work unit."""


@dataclass
class Wait:
    """Stage that sleeps for `plan.limits.render_seconds`."""

    plan: Plan

    def run(self, files: SeedFiles) -> dict[str, Any]:
        """Sleep."""
        time.sleep(self.plan.limits.render_seconds)
        return {"success": True, "steps": 1}

    def close(self) -> None:
        """Close nothing."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    plan = Plan.model_validate(
        {
            "parts": [PartConfig(task="pick", config="pick_table_scattered", episodes=cfg.units, name="waits")],
            "stages": ["demonstrations"],
            "block": 1,
            "limits": {"render_seconds": cfg.seconds},
        },
        strict=False,
    )
    worker.Recorder = Wait  # pyright: ignore[reportAttributeAccessIssue]
    with tempfile.TemporaryDirectory() as tmp:
        folder, start = PlanFolder(plan, Path(tmp) / "out"), time.time()
        cpu = time.process_time()
        run_shard(LocalExecutor(folder, cfg.workers), (0, 1))
        cpu = time.process_time() - cpu
        units = [WorkUnit(0, block) for block in range(cfg.units)]
        at = np.sort([one.end_time for unit in units for one in folder.read_outcomes(unit) or ()])
    # from the start of the last worker until the first worker is idle
    first, last = 2 * cfg.workers, cfg.units - cfg.workers
    rate = (last - first) / (at[last] - at[first])
    report = {
        "units": cfg.units,
        "workers": cfg.workers,
        "cores": os.cpu_count(),
        "seconds_a_unit": cfg.seconds,
        "units_per_second": round(float(rate), 2),
        "overhead_percent": round(100 * (cfg.workers / cfg.seconds / float(rate) - 1), 2),
        "wall_seconds": round(float(at[-1] - start), 1),
        "seconds_to_start": round(float(at[cfg.workers - 1] - start) - cfg.seconds, 1),
        "runner_cpu_ms_a_unit": round(1000 * cpu / cfg.units, 2),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
