"""Real commands, and what faults of all kinds do to them: what `tests/faults` are made of."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path

import h5py
import numpy as np
import psutil

from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.datasets.conversion.episode_folder import find_damaged
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.failures import FAILURES_FILE, FailedAttempt
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_trajectory
from robocas_ms3.evaluation import results
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

ROOT = Path(__file__).resolve().parents[2]
SITE = Path(__file__).resolve().parent / "fault_site"
PATIENCE = 900  # s that a command may take on a busy machine
EPISODES = 4


@dataclass(frozen=True)
class Command:
    """A command that makes four episodes.

    Attributes:
        name: of the command.
        words: it consists of, but for the folder and --jobs.
        jobs: the flag that says how many processes.
        hit: what faults happen to: a seed, or a number of an episode.
        limits: flags of what an episode may take, while it hangs, and while it grows.
        finished: (folder) -> how many episodes are finished.
    """

    name: str
    words: tuple[str, ...]
    jobs: str = "--jobs"
    hit: int = 1
    slow: tuple[str, ...] = ("--episode-seconds", "45")
    large: tuple[str, ...] = ("--memory-gb", "1.5")

    def line(self, out, jobs=2, *more):
        return [
            sys.executable,
            str(ROOT / "robocas_cli.py"),
            *self.words,
            "--out",
            str(out),
            self.jobs,
            str(jobs),
            *more,
        ]

    def finished(self, out):
        patterns = {
            "generate": "episodes/seed_*.h5",
            "convert": "episode_*",
            "plan run": "units/*/*/[0-9]*/outcome.json",  # not in a temporary folder
            "eval": "episodes.jsonl",
        }
        found = list(out.glob(patterns[self.name])) + list(out.glob("trajectory.h5")) * EPISODES
        if self.name == "eval":
            return sum(path.read_bytes().count(b"\n") for path in found if path.name != "trajectory.h5")
        return len(found)


def content(command, out):
    """(episode, what came of it), without what a clock said; none may be there twice."""
    if command.name == "generate":
        episodes = json.loads((out / "trajectory.json").read_text())["episodes"]
        lines: list[FailedAttempt] = JsonLinesFile(out / FAILURES_FILE, FailedAttempt).read()
        failed = {seed: list(of) for seed, of in groupby(lines, lambda line: line.seed)}
        assert list(failed) == sorted({line.seed for line in lines})
        with open_trajectory(out / "trajectory.h5") as file:
            found = [
                (seed, (_of_recording(one, file[f"traj_{one['episode_id']}"]), _causes(failed.get(seed, []))))
                for seed, one in ((one["episode_seed"], one) for one in episodes)
            ]
    elif command.name == "eval":
        found = [(number, one.reproducible_values()) for number, one in results.read_result(out).outcomes.items()]
    elif command.name == "convert":
        found = [(path.name, files_of(path)) for path in sorted(out.glob("episode_*"))]
    else:  # by seed: where one was left out, the numbers of others are others, which their scenes say
        data = Dataset(out / "datasets" / "robocas")
        folders = {data.entry(number)["seed"]: data.root / f"episode_{number:07d}" for number in data.numbers}
        assert len(folders) == len(data.numbers)
        found = [(seed, {k: v for k, v in files_of(one).items() if k != "scene.json"}) for seed, one in folders.items()]
    return found


def readable(command, out):
    """How many episodes of a run that ended early are there, each of which is whole."""
    if command.name == "generate":
        recorded = sorted((out / "episodes").glob("seed_*.h5"))
        for path in recorded:
            with TrajectoryFile(path) as file:
                assert len(file.recording(0).actions)
        return len(recorded)
    if command.name == "eval":
        lines = (out / "episodes.jsonl").read_bytes().splitlines(keepends=True)
        return sum(bool(json.loads(line)) for line in lines if line.endswith(b"\n"))
    folders = sorted(out.glob("episode_*" if command.name == "convert" else "units/*/*/[0-9]*/episode_*"))
    for folder in folders:
        assert find_damaged(folder, ImageOptions(STANDARD_CAMERA_NAMES, (64, 48), depth=False)) is None, folder
    return len(folders)


def _causes(failures):
    """Without the seconds of a clock."""
    return [(one.attempt, one.stage, one.reason) for one in failures]


def _of_recording(episode, group):
    said = {**episode, "episode_id": 0, "robocas": {k: v for k, v in episode["robocas"].items() if k != "seconds"}}
    arrays = {}
    group.visititems(lambda name, item: arrays.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return json.dumps(said, sort_keys=True), {name: np.asarray(value).tobytes() for name, value in arrays.items()}


@dataclass
class Row:
    """A line of the table."""

    fault: str
    command: str
    injected: int = 0
    lost: int = 0
    doubled: int = 0
    seconds: list[float] = field(default_factory=list)
    """until a task began after it"""
    note: str = ""

    def judge(self, expected, found, without=()):
        """Count what is lost and doubled, and see that all others are as they were."""
        numbers = [number for number, _ in found]
        self.doubled += len(numbers) - len(set(numbers))
        there = dict(found)
        self.lost += sum(number not in there for number, _ in expected)
        different = [number for number, one in expected if number in there and there[number] != one]
        assert set(different) <= set(without), (self, different)


def environment(fault=None):
    """Of a command that something befalls."""
    path = os.pathsep.join([str(SITE), str(ROOT)])
    return {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "ignore", "ROBOCAS_FAULT": json.dumps(fault or {})}


@contextmanager
def running(words, fault=None):
    """A command in a group of processes of its own; none is left in the end."""
    process = subprocess.Popen(
        words,
        env=environment(fault),
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509  (a shell may ignore it)
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def run(words, fault=None):
    """Run it to its end: exit code, stderr."""
    with running(words, fault) as process:
        _, said = process.communicate(timeout=PATIENCE)
    return process.returncode, said


def succeed(words, fault=None):
    code, said = run(words, fault)
    assert code == 0, (words, said[-2000:])
    return said


def wait_until(what, process):
    until = time.monotonic() + PATIENCE
    while not what():
        assert process.poll() is None, process.communicate()[1][-2000:]
        assert time.monotonic() < until
        time.sleep(0.05)


def begun(log):
    """(when, which) of the tasks that began."""
    if not log.is_file():
        return []
    return [(float(when), key) for when, key in map(str.split, log.read_text().splitlines())]


def alive(group):
    """Processes of a group that have not ended."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def lines_of(said):
    """What is left of stderr without the lines of progress."""
    progress = re.compile(r"([a-z ]+: )?\d+ of \d+( episodes)?(,|$)")
    return [line for line in said.splitlines() if line.strip() and not progress.match(line)]


def is_one_line(said):
    """One error, and nothing of tracebacks."""
    errors = [line for line in lines_of(said) if line.startswith("error: ")]
    return len(errors) == 1 and "Traceback" not in said


def files_of(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def note(row):
    """Add a line to the file of ROBOCAS_FAULT_ROWS."""
    if path := os.environ.get("ROBOCAS_FAULT_ROWS"):
        with Path(path).open("a") as file:
            file.write(json.dumps(asdict(row)) + "\n")
