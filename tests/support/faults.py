"""Run real commands with injected faults and compare their files: helpers of `tests/faults`."""

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
from robocas_ms3.datasets.conversion.episode_folder import find_damaged_file
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.candidates.candidates_file import FILE_NAME as CANDIDATES_FILE
from robocas_ms3.demos.candidates.candidates_file import CandidateFile
from robocas_ms3.demos.failures import FAILURES_FILE, FailedAttempt
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_trajectory
from robocas_ms3.evaluation.results.result_files import read_result
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

ROOT = Path(__file__).resolve().parents[2]
SITE = Path(__file__).resolve().parent / "fault_site"
PATIENCE = 900  # s, limit of a command on a busy machine
EPISODES = 4


@dataclass(frozen=True)
class Command:
    """A command that produces four episodes.

    Attributes:
        name: name of the command.
        words: words of the command line, without output folder and --jobs.
        jobs: option for the number of processes.
        hit: task that a fault affects: a seed, or the number of an episode.
        slow, large: options that limit the time and the memory of an episode.
    """

    name: str
    words: tuple[str, ...]
    jobs: str = "--jobs"
    hit: int = 1
    slow: tuple[str, ...] = ("--episode-seconds", "45")
    large: tuple[str, ...] = ("--memory-gb", "1.5")

    def line(self, out, jobs=2, *more):
        """Return the words of the command line."""
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
        """Return the number of finished episodes in an output folder."""
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
    """Return (episode, content) of each episode in an output folder, without measured times; check duplicates."""
    if command.name == "generate":
        episodes = json.loads((out / "trajectory.json").read_text())["episodes"]
        lines: list[FailedAttempt] = JsonLinesFile(out / FAILURES_FILE, FailedAttempt).read()
        failed = {seed: list(of) for seed, of in groupby(lines, lambda line: line.seed)}
        assert list(failed) == sorted({line.seed for line in lines})
        with open_trajectory(out / "trajectory.h5") as file:
            found = [
                (
                    seed,
                    (
                        _of_recording(one, file[f"traj_{one['episode_id']}"]),
                        _causes(failed.get(seed, [])),
                        _of_candidates(out / CANDIDATES_FILE, seed),
                    ),
                )
                for seed, one in ((one["episode_seed"], one) for one in episodes)
            ]
    elif command.name == "eval":
        found = [(number, one.reproducible_values()) for number, one in read_result(out).outcomes.items()]
    elif command.name == "convert":
        found = [(path.name, files_of(path)) for path in sorted(out.glob("episode_*"))]
    else:  # by seed: without a skipped seed, other episodes have other numbers, which scene.json contains
        data = Dataset(out / "datasets" / "robocas")
        folders = {
            data.conversion_entry(number)["seed"]: data.root / f"episode_{number:07d}" for number in data.numbers
        }
        assert len(folders) == len(data.numbers)
        found = [(seed, {k: v for k, v in files_of(one).items() if k != "scene.json"}) for seed, one in folders.items()]
    return found


def _of_candidates(path, seed):
    """Return the values of the decisions of a seed and of their candidates, as texts."""
    file = CandidateFile(path)
    rows = [row for row, of in enumerate(file.decisions["seed"].tolist()) if of == seed]
    assert rows, f"no decisions of seed {seed}"
    return [
        (repr(sorted(one.values.items())), repr(sorted((k, v.tolist()) for k, v in one.candidates.items())))
        for one in map(file.decision, rows)
    ]


def count_readable(command, out):
    """Return the number of episodes of an interrupted run; check that each is complete."""
    if command.name == "generate":
        recorded = sorted((out / "episodes").glob("seed_*.h5"))
        for path in recorded:
            with TrajectoryFile(path) as file:
                assert len(file.read_recording(0).actions)
        return len(recorded)
    if command.name == "eval":
        lines = (out / "episodes.jsonl").read_bytes().splitlines(keepends=True)
        return sum(bool(json.loads(line)) for line in lines if line.endswith(b"\n"))
    folders = sorted(out.glob("episode_*" if command.name == "convert" else "units/*/*/[0-9]*/episode_*"))
    for folder in folders:
        assert find_damaged_file(folder, ImageOptions(STANDARD_CAMERA_NAMES, (64, 48), depth=False)) is None, folder
    return len(folders)


def _causes(failures):
    """Return attempts, stages and reasons, without measured times."""
    return [(one.attempt, one.stage, one.reason) for one in failures]


def _of_recording(episode, group):
    stderr = {**episode, "episode_id": 0, "robocas": {k: v for k, v in episode["robocas"].items() if k != "seconds"}}
    arrays = {}
    group.visititems(lambda name, item: arrays.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return json.dumps(stderr, sort_keys=True), {name: np.asarray(value).tobytes() for name, value in arrays.items()}


@dataclass
class Row:
    """A row of the fault table."""

    fault: str
    command: str
    injected: int = 0
    lost: int = 0
    duplicates: int = 0
    seconds: list[float] = field(default_factory=list)
    """From the fault to the next start of a task."""
    note: str = ""

    def compare(self, expected, found, without=()):
        """Count lost and duplicate episodes; check that all other episodes, except `without`, are unchanged."""
        numbers = [number for number, _ in found]
        self.duplicates += len(numbers) - len(set(numbers))
        contents = dict(found)
        self.lost += sum(number not in contents for number, _ in expected)
        different = [number for number, content in expected if contents.get(number, content) != content]
        assert set(different) <= set(without), (self, different)


def environment(fault=None):
    """Return the environment variables of a command with a fault."""
    path = os.pathsep.join([str(SITE), str(ROOT)])
    return {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "ignore", "ROBOCAS_FAULT": json.dumps(fault or {})}


@contextmanager
def running_command(words, fault=None):
    """Start a command in a new process group, yield its process, and kill the group at the end."""
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
    """Run a command; return its exit status and stderr."""
    with running_command(words, fault) as process:
        _, stderr = process.communicate(timeout=PATIENCE)
    return process.returncode, stderr


def run_successfully(words, fault=None):
    code, stderr = run(words, fault)
    assert code == 0, (words, stderr[-2000:])
    return stderr


def wait_until(condition, process):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert process.poll() is None, process.communicate()[1][-2000:]
        assert time.monotonic() < deadline
        time.sleep(0.05)


def task_starts(log):
    """Return (time, key) of each start of a task."""
    if not log.is_file():
        return []
    return [(float(when), key) for when, key in map(str.split, log.read_text().splitlines())]


def live_processes(group):
    """Return the processes of a group that have not ended."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def lines_without_progress(stderr):
    """Return the lines of stderr without progress lines."""
    progress = re.compile(r"[a-z ]+: \d+/\d+( \(|,|$)")
    return [line for line in stderr.splitlines() if line.strip() and not progress.match(line)]


def is_single_error(stderr):
    """Return whether stderr has exactly one error line and no traceback."""
    errors = [line for line in lines_without_progress(stderr) if line.startswith("error: ")]
    return len(errors) == 1 and "Traceback" not in stderr


def files_of(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def write_row(row):
    """Append a row to the file in ROBOCAS_FAULT_ROWS."""
    if path := os.environ.get("ROBOCAS_FAULT_ROWS"):
        with Path(path).open("a") as file:
            file.write(json.dumps(asdict(row)) + "\n")
