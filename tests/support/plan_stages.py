"""Stages of an episode without a simulator; a file next to the plan makes them fail, crash, hang or grow."""

from __future__ import annotations

import filecmp
import json
import os
import signal
import time
from contextlib import contextmanager
from pathlib import Path

from synthetic import RayCaster, write_trajectory

from robocas_ms3.core.errors import DatasetError, MissingExtraError
from robocas_ms3.plans import worker
from robocas_ms3.plans.folder import PlanFolder, WorkUnit
from robocas_ms3.plans.plan import PartConfig, Plan
from robocas_ms3.plans.worker import Renderer

SITE = Path(__file__).parent / "fault_site"


class StubRecorder:
    """Stage that writes a synthetic recording."""

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
        elif fault == "kill job":
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(60)
        elif fault == "bug":
            raise ValueError("a bug\nof two lines")
        elif fault == "refuse":
            raise MissingExtraError("nothing to record with")
        elif fault == "damaged":
            raise DatasetError("this recording is damaged")
        elif fault == "fail":
            return {"success": False, "failures": ["grasp: slipped"]}
        write_trajectory(files.recording_path, seeds=(files.seed,))
        return {"success": True, "steps": 22}

    def close(self):
        pass


def _faults_of(out):
    """Return the folder with the faults of a plan: its parent, or a folder that all Ray nodes share."""
    return Path(os.environ.get("PLAN_FAULTS", out.parent))


def _fault(files):
    folder = _faults_of(files.folder.parents[3])
    if not (folder / "faults.json").is_file():
        return None
    planned = json.loads((folder / "faults.json").read_text()).get(str(files.seed), [])
    with (folder / f"tries-{files.seed}").open("a") as file:
        file.write(f"{os.getpid()} ")
    number = len((folder / f"tries-{files.seed}").read_text().split()) - 1
    return planned[number] if number < len(planned) else None


class StubRenderer(Renderer):
    """Stage that renders by ray casting."""

    def open_env(self, *args):
        return RayCaster(*args)


class FailingStage:
    def __init__(self, plan):
        raise ImportError("no such library")


@contextmanager
def stub_stages(record=StubRecorder, render=StubRenderer):
    """Replace the stages of workers that are made within the block."""
    before = worker.Recorder, worker.Renderer
    worker.Recorder, worker.Renderer = record, render
    try:
        yield
    finally:
        worker.Recorder, worker.Renderer = before


def run_here(out, plan=None, jobs=1, record=StubRecorder, render=StubRenderer, **more):
    """Run the synthetic plan on this machine."""
    from robocas_ms3.plans.executors import LocalExecutor
    from robocas_ms3.plans.run import run_plan

    with stub_stages(record, render):
        return run_plan(LocalExecutor(PlanFolder(plan or PLAN, out), jobs), **more)


def env_of_jobs():
    """Return environment variables of processes whose workers have stub stages."""
    path = os.pathsep.join([str(SITE), str(SITE.parent), os.environ.get("PYTHONPATH", "")])
    return {"PYTHONPATH": path, "ROBOCAS_FAULT": json.dumps({"stub_plan": True})}


PLAN = Plan.model_validate(
    {
        "parts": [
            PartConfig(task="pick", config="pick_table_scattered", episodes=5, seed=10, name="a"),
            PartConfig(task="pick", config="pick_shelf_scattered", episodes=2, seed=3, name="b"),
        ],
        "stages": ["demonstrations", "datasets"],
        "images": {"size": [64, 48]},
        "embeddings": False,
        "block": 3,
        "limits": {"record_seconds": 60, "render_seconds": 60, "memory_gb": 4},
    },
    strict=False,
)


def plan_faults(out, faults):
    """Write the faults of a plan; return a function that returns the process ids of the tries of a seed.

    Args:
        faults: by seed, the faults of its first tries; later tries have none.
    """
    folder = _faults_of(out)
    for old in folder.glob("tries-*"):
        old.unlink()
    (folder / "faults.json").write_text(json.dumps(faults))

    def tries(seed):
        path = folder / f"tries-{seed}"
        text = path.read_text() if path.exists() else ""
        return [int(pid) for pid in text.split(" ")[:-1]]

    return tries


def products(out):
    """Return the paths of the products of a plan that contain no measured times."""
    return {
        path.relative_to(out)
        for name in ("demos", "datasets", "report.json")
        for path in ([out / name] if (out / name).is_file() else (out / name).rglob("*"))
        if path.is_file()
    }


def assert_same(one, other):
    """Check that two plans have equal products, and that the second one deleted its work units except outcomes."""
    assert products(one) == products(other) != set()
    assert not [path for path in products(one) if not filecmp.cmp(one / path, other / path, shallow=False)]
    assert {path.name for path in (other / "units").glob("*/*/*")} == {"seeds.jsonl"}


def crashes_of(out, plan=PLAN):
    """Return (seed, reason) of the crashes in complete work units."""
    units = [WorkUnit(part, block) for part in range(len(plan.parts)) for block in range(9)]
    found = (PlanFolder(plan, out).read_outcomes(unit) for unit in units)
    return [(one.seed, crash) for outcomes in found if outcomes for one in outcomes for crash in one.crashes]


def seeds_done(out):
    """Return the number of finished seeds."""
    units = {path.parent for path in out.glob("units/*/*/seeds.jsonl")}
    complete = sum(len((unit / "seeds.jsonl").read_text().splitlines()) for unit in units)
    return complete + sum(path.parent.parent not in units for path in out.glob("units/*/*/*/outcome.json"))
