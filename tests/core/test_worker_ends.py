"""End of worker processes: Ctrl-C, end of the program, unclosed pools."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from robocas_ms3.core import worker_process
from robocas_ms3.core.worker_process import NO_LIMITS, WorkerProcess

PROGRAM = """
import ctypes, os, sys, time
from functools import partial
from pathlib import Path
from robocas_ms3.core.signals import die_with_parent
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

folder, kind = Path(sys.argv[1]), sys.argv[2]

def run(task):
    (folder / "started" / str(os.getpid())).touch()
    if kind == "native":
        ctypes.PyDLL(None).sleep(60)  # holds Python's lock
    if kind == "forks":
        worker = os.getpid()
        if not os.fork():
            die_with_parent(worker)
            (folder / "started" / str(os.getpid())).touch()
    if kind != "short":
        time.sleep(60)

def make_worker():
    (folder / "making" / str(os.getpid())).touch()
    if kind == "slow start":
        time.sleep(1.5)
    return FunctionWorker(run)

try:
    if kind == "short":
        WorkerPool(make_worker, 2).run(0)
        sys.exit()
    with WorkerPool(make_worker, 2) as pool:
        list(pool.map(range(20)))
except KeyboardInterrupt:
    sys.exit(130)
"""


def start(folder, kind):
    """Start the program in a new session."""
    for name in ("making", "started"):
        (folder / name).mkdir()
    (folder / "program.py").write_text(PROGRAM)
    words = [sys.executable, str(folder / "program.py"), str(folder), kind]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    return subprocess.Popen(words, env=env, stderr=subprocess.PIPE, text=True, start_new_session=True)


def wait_for(folder, count, program):
    """Wait until ``count`` processes have written a file, and return them."""
    while len(paths := list(folder.iterdir())) < count:
        time.sleep(0.02)
        assert program.poll() is None
    return [psutil.Process(int(path.name)) for path in paths]


def have_ended(processes):
    until = time.monotonic() + 10
    while (running := [one for one in processes if one.is_running()]) and time.monotonic() < until:
        if all(one.status() == psutil.STATUS_ZOMBIE for one in running):
            return True
        time.sleep(0.05)
    return not running


@pytest.mark.parametrize(("kind", "count"), [("sleeps", 2), ("native", 2), ("forks", 4)])
def test_workers_end_when_the_program_is_killed(tmp_path, kind, count):
    with start(tmp_path, kind) as program:
        workers = wait_for(tmp_path / "started", count, program)
        time.sleep(0.5)
        assert all(worker.is_running() for worker in workers)
        program.kill()
        assert have_ended(workers)


@pytest.mark.parametrize(("kind", "count"), [("sleeps", 2), ("forks", 4)])
def test_ctrl_c_ends_running_tasks_starts_none_and_prints_nothing(tmp_path, kind, count):
    with start(tmp_path, kind) as program:
        workers = wait_for(tmp_path / "started", count, program)
        os.killpg(program.pid, signal.SIGINT)  # as a terminal does: to all of them
        assert program.communicate(timeout=60)[1] == ""
        assert program.returncode == 130
        assert have_ended(workers)
        assert len(list((tmp_path / "started").iterdir())) == count


def test_ctrl_c_while_processes_start_runs_no_task(tmp_path):
    with start(tmp_path, "slow start") as program:
        wait_for(tmp_path / "making", 1, program)
        os.killpg(program.pid, signal.SIGINT)
        assert program.communicate(timeout=60)[1] == ""
        assert program.returncode == 130
        assert list((tmp_path / "started").iterdir()) == []


def test_an_unclosed_pool_does_not_block_the_end_of_the_program(tmp_path):
    with start(tmp_path, "short") as program:
        try:
            assert (program.communicate(timeout=60)[1], program.returncode) == ("", 0)
        finally:
            program.kill()


def test_a_process_is_ended_while_another_thread_launches_it(monkeypatch):  # as Ctrl-C does
    class EndsItself(worker_process.Connection):
        """The end of the process, which is closed as soon as the process runs."""

        def __exit__(self, *_):
            self.close()
            pids.append(process.pid)
            process.quit()

    def pipe():
        ours, theirs = connections()
        return ours, EndsItself(os.dup(theirs.fileno()))

    connections, pids = worker_process.Pipe, []
    process = WorkerProcess(dict, NO_LIMITS, connections(duplex=False)[0])
    monkeypatch.setattr(worker_process, "Pipe", pipe)
    process.launch()
    assert not psutil.pid_exists(pids[0])
