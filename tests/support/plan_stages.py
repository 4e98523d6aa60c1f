"""Stages of an episode that need no simulator, and fail, crash, hang or grow as a file beside the units says."""

from __future__ import annotations

import filecmp
import json
import os
import signal
import time

from synthetic import RayCaster, write_trajectory

from robocas_ms3.core.errors import DatasetError, MissingExtraError, RobocasError
from robocas_ms3.core.files import replacing_folder
from robocas_ms3.plans.plan import PartConfig, Plan
from robocas_ms3.plans.render import Renders
from robocas_ms3.plans.slot import Stages
from robocas_ms3.plans.units import ledger

FAULTS = "faults.json"
"""Seed -> what happens at each of its tries, the first ones first; nothing more where the list ends."""


class MadeUp:
    """Writes a made-up recording."""

    def __init__(self, plan):
        self.plan = plan

    def run(self, task):
        fault = _fault(task)
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
        elif fault == "limit":  # as `demos.forking` has it
            raise RobocasError("can't start another process")
        elif fault == "damaged":
            raise DatasetError("this recording is damaged")
        elif fault == "fail":
            return {"success": False, "failures": ["grasp: slipped"]}
        if not task.recording.is_file():
            with replacing_folder(task.folder / f".made_{task.seed}") as folder:
                made = write_trajectory(folder / task.recording.name, seeds=(task.seed,))
                os.replace(made.with_suffix(".json"), task.recording.with_suffix(".json"))
                os.replace(made, task.recording)
            os.rmdir(task.folder / f".made_{task.seed}")
        return {"success": True, "steps": 22}

    def close(self):
        pass


def _fault(task):
    out = task.folder.parents[2]
    path = out.with_name(f"{out.name}-{FAULTS}")
    tries = out.with_name(f"{out.name}-tries-{task.seed}")
    if not path.is_file():
        return None
    planned = json.loads(path.read_text()).get(str(task.seed), [])
    with tries.open("a") as file:
        file.write("x")
    number = tries.stat().st_size - 1
    return planned[number] if number < len(planned) else None


def render(plan):
    return Renders(plan, RayCaster)


def cannot_begin(plan):
    raise OSError("no such device\nat all")


def stages():
    return Stages(MadeUp, render)


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
    """See that two plans made the same, byte for byte, and that the second did nothing twice and left nothing half."""
    assert products(one) == products(other) != set()
    assert not [path for path in products(one) if not filecmp.cmp(one / path, other / path, shallow=False)]
    for folder in (other / "units").glob("*/*"):
        seeds = [outcome.seed for outcome in ledger(folder).read()]
        assert len(set(seeds)) == len(seeds)
        assert (folder / "done.json").is_file()
        assert not list(folder.glob(".*"))
