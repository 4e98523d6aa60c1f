"""Stages of an episode that need no simulator, and fail, crash, hang or grow as a file beside the units says."""

from __future__ import annotations

import filecmp
import json
import os
import signal
import time

from synthetic import RayCaster, write_trajectory

from robocas_ms3.core.errors import DatasetError, MissingExtraError, RobocasError
from robocas_ms3.plans.executors import LocalExecutor
from robocas_ms3.plans.plan import PartConfig, Plan
from robocas_ms3.plans.render import Renderer
from robocas_ms3.plans.run import run_plan
from robocas_ms3.plans.units import Unit
from robocas_ms3.plans.worker import UnitWorker

FAULTS = "faults.json"
"""Seed -> what happens at each of its tries, the first ones first; nothing more where the list ends."""


class MadeUp:
    """Writes a made-up recording."""

    def __init__(self, plan):
        self.plan = plan

    def run(self, files):
        fault = _fault(files)
        if fault == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        elif fault == "hang":
            time.sleep(1000)
        elif fault == "grow":
            hog = bytearray(600 * 2**20)
            time.sleep(1000)
            del hog
        elif fault == "bug":
            raise ValueError("a bug\nof two lines")
        elif fault == "refuse":
            raise MissingExtraError("nothing to record with")
        elif fault == "limit":  # as `demos.branches` has it
            raise RobocasError("can't start another process")
        elif fault == "damaged":
            raise DatasetError("this recording is damaged")
        elif fault == "fail":
            return {"success": False, "failures": ["grasp: slipped"]}
        write_trajectory(files.recording, seeds=(files.seed,))
        return {"success": True, "steps": 22}

    def close(self):
        pass


def _fault(files):
    out = files.folder.parents[3]
    path = out.with_name(f"{out.name}-{FAULTS}")
    tries = out.with_name(f"{out.name}-tries-{files.seed}")
    if not path.is_file():
        return None
    planned = json.loads(path.read_text()).get(str(files.seed), [])
    with tries.open("a") as file:
        file.write(f"{os.getpid()} ")
    number = len(tries.read_text().split()) - 1
    return planned[number] if number < len(planned) else None


def render(plan):
    return Renderer(plan, RayCaster)


def cannot_begin(plan):
    raise ImportError("no such library")


def open_worker(plan, out):
    """A worker whose episodes are made up."""
    return UnitWorker(plan, out, MadeUp, render)


def run_here(out, plan=None, jobs=1, open_worker=open_worker, **more):
    """Run the made-up plan on this machine."""
    return run_plan(LocalExecutor(plan or PLAN, out, jobs, open_worker=open_worker), **more)


PLAN = Plan.model_validate(
    {
        "parts": [
            PartConfig(task="pick", config="pick_table_scattered", episodes=5, seed=10, name="a"),
            PartConfig(task="pick", config="pick_shelf_scattered", episodes=2, seed=3, name="b"),
        ],
        "stages": ["demonstrations", "datasets"],
        "pictures": {"size": [64, 48]},
        "embeddings": False,
        "block": 3,
        "limits": {"record_seconds": 60, "render_seconds": 60, "memory_gb": 4},
    },
    strict=False,
)


def plan_faults(out, faults):
    """Seed -> what happens at each of its tries."""
    out.with_name(f"{out.name}-{FAULTS}").write_text(json.dumps(faults))


def products(out):
    """Paths of what a plan makes, without what a clock says."""
    return {
        path.relative_to(out)
        for name in ("demos", "datasets", "report.json")
        for path in ([out / name] if (out / name).is_file() else (out / name).rglob("*"))
        if path.is_file()
    }


def assert_same(one, other):
    """See that two plans made the same, byte for byte, and that the second left nothing but its outcomes."""
    assert products(one) == products(other) != set()
    assert not [path for path in products(one) if not filecmp.cmp(one / path, other / path, shallow=False)]
    assert {path.name for path in (other / "units").glob("*/*/*")} == {"seeds.jsonl"}


def deaths_of(out, plan=PLAN):
    """(seed, what its process died of) in units that are complete."""
    units = [Unit(part, block) for part in range(len(plan.parts)) for block in range(9)]
    found = (unit.outcomes(plan, out) for unit in units)
    return [(one.seed, death) for outcomes in found if outcomes for one in outcomes for death in one.deaths]


def seeds_done(out):
    """How many seeds are done."""
    units = {path.parent for path in out.glob("units/*/*/seeds.jsonl")}
    whole = sum(len((unit / "seeds.jsonl").read_text().splitlines()) for unit in units)
    return whole + sum(path.parent.parent not in units for path in out.glob("units/*/*/*/outcome.json"))
