"""Inject faults into workers of real commands: processes with this folder on PYTHONPATH read ROBOCAS_FAULT.

{"log": FILE, "at": {"key": KEY, "fault": FAULT, "times": N}, "backwards": true, "versions": {PACKAGE: VERSION},
"stub_episodes": true, "stub_plan": true}

A line "CLOCK KEY" is appended to FILE at each start of a task; KEY is a seed or the number of an episode. At the first
N starts of the task KEY the process crashes, hangs or grows. "backwards": the clock runs backwards. "versions":
reported versions of packages. "stub_episodes": episodes are generated without a simulator. "stub_plan": workers of
plans have the stages of plan_stages.
"""

import importlib.abc
import importlib.util
import json
import os
import signal
import sys
import time
import types

FAULT = json.loads(os.environ.get("ROBOCAS_FAULT", "{}"))
_MONOTONIC, _SLEEP, _TIME = time.monotonic, time.sleep, time.time
POINTS = {  # module -> (class, method, function that returns the key of a task)
    "robocas_ms3.demos.generation": ("_EpisodeWorker", "run", lambda seed: seed),
    "robocas_ms3.datasets.conversion.workers": ("_EpisodeWorker", "run", lambda task: task[0]),
    "robocas_ms3.plans.worker": ("Recorder", "run", lambda files: files.seed),
    "robocas_ms3.evaluation.rollouts.action_wrapper": (
        "PolicyActionWrapper",
        "reset",
        lambda seed=None, **_: int(seed or 0),
    ),
}


def inject(key):
    at = FAULT.get("at", {})
    with open(FAULT["log"], "a+") as log:
        log.write(f"{_MONOTONIC()} {key}\n")
        log.seek(0)
        starts = sum(line.split()[1] == str(key) for line in log.read().splitlines())
    if str(key) != str(at.get("key")) or starts > at["times"]:
        return
    if at["fault"] == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if at["fault"] == "grow":
        hog = bytearray(1700 * 2**20)
        _SLEEP(1000)
        del hog
    _SLEEP(1000)


class Finder(importlib.abc.MetaPathFinder):
    """Changes modules after they are loaded."""

    def __init__(self, points):
        self.points = points  # module -> function that changes it

    def find_spec(self, name, path, target=None):
        if name not in self.points:
            return None
        sys.meta_path.remove(self)
        try:
            spec = importlib.util.find_spec(name)
        finally:
            sys.meta_path.insert(0, self)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def exec_module(module):
                load(module)
                self.points[name](module)

            spec.loader.exec_module = exec_module
        return spec


def wrap(module, owner, name, key_of):
    method = getattr(getattr(module, owner), name)

    def method_with_fault(self, *args, **kwargs):
        inject(key_of(*args, **kwargs))
        return method(self, *args, **kwargs)

    setattr(getattr(module, owner), name, method_with_fault)


def use_stub_stages(worker):
    if "plan_stages" not in sys.modules:
        import plan_stages

        worker.Recorder, worker.Renderer = plan_stages.StubRecorder, plan_stages.StubRenderer


if "log" in FAULT:
    sys.meta_path.insert(0, Finder({name: lambda module, at=at: wrap(module, *at) for name, at in POINTS.items()}))
if "stub_plan" in FAULT:
    sys.meta_path.insert(0, Finder({"robocas_ms3.plans.worker": use_stub_stages}))
if FAULT.get("stub_episodes"):

    class StubGeneratorFinder(importlib.abc.MetaPathFinder):
        def find_spec(self, name, path, target=None):
            if name == "robocas_ms3.demos.generator":
                return importlib.util.spec_from_file_location(name, f"{os.path.dirname(__file__)}/stub_generator.py")
            return None

    sys.meta_path.insert(0, StubGeneratorFinder())
    sys.modules["torch"] = types.SimpleNamespace(set_num_threads=lambda number: None)  # its import takes seconds
if FAULT.get("backwards"):
    _START = _TIME()
    time.time = lambda: 2 * _START - _TIME() - 86400
if "versions" in FAULT:
    import importlib.metadata

    _version = importlib.metadata.version
    importlib.metadata.version = lambda name: FAULT["versions"].get(name) or _version(name)
