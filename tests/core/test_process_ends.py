"""How a program with processes ends: Ctrl-C, its death, what nobody ended."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = """
import sys
from pathlib import Path
from robocas_ms3.core.processes import Calls, Pool
from functools import partial
import os, time
def wait(task):
    (Path(sys.argv[1]) / f"{task}-{os.getpid()}").touch()
    time.sleep(60)
if __name__ == "__main__":
    try:
        with Pool(partial(Calls, wait), 2) as pool:
            list(pool.do(range(20)))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def begin(folder):
    """The program, in a session of its own."""
    words = [sys.executable, str(folder / "program.py"), str(folder / "begun")]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    return subprocess.Popen(words, env=env, stderr=subprocess.PIPE, text=True, start_new_session=True)


@pytest.fixture
def running(tmp_path):
    """A program whose two workers wait for long, and the ids of these."""
    (tmp_path / "begun").mkdir()
    (tmp_path / "program.py").write_text(PROGRAM)
    with begin(tmp_path) as program:
        while len(begun := list((tmp_path / "begun").iterdir())) < 2:
            time.sleep(0.02)
            assert program.poll() is None
        yield program, [int(path.name.partition("-")[2]) for path in begun]
        program.kill()


def gone(pid):
    """Whether a process is no more, or dead and not buried yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def all_gone(pids, seconds=10):
    deadline = time.monotonic() + seconds
    while not all(map(gone, pids)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return all(map(gone, pids))


def test_workers_end_with_a_parent_that_is_killed(running):
    program, workers = running
    program.kill()
    assert all_gone(workers)


def test_workers_end_with_a_parent_that_is_killed_though_native_code_holds_python_s_lock(tmp_path):
    (tmp_path / "begun").mkdir()
    (tmp_path / "program.py").write_text(
        PROGRAM.replace("    time.sleep(60)", "    import ctypes\n    ctypes.PyDLL(None).sleep(60)")
    )
    with begin(tmp_path) as program:
        while len(begun := list((tmp_path / "begun").iterdir())) < 2:
            time.sleep(0.02)
            assert program.poll() is None
        workers = [int(path.name.partition("-")[2]) for path in begun]
        time.sleep(0.5)
        assert not any(map(gone, workers))
        program.kill()
        assert all_gone(workers)


def test_ctrl_c_while_processes_start_begins_nothing_either(tmp_path):
    (tmp_path / "begun").mkdir()
    starting = (
        "\nif __name__ != '__main__':\n    (Path(__file__).parent / str(os.getpid())).touch()\n    time.sleep(1.5)\n"
    )
    (tmp_path / "program.py").write_text(PROGRAM.replace("import os, time\n", "import os, time" + starting))
    program = begin(tmp_path)
    while not list(tmp_path.glob("[0-9]*")):
        time.sleep(0.02)
        assert program.poll() is None
    os.killpg(program.pid, signal.SIGINT)
    assert program.communicate(timeout=60)[1] == ""
    assert program.returncode == 130
    assert list((tmp_path / "begun").iterdir()) == []


def test_ctrl_c_ends_what_is_under_way_begins_nothing_and_prints_nothing(running, tmp_path):
    program, workers = running
    os.killpg(program.pid, signal.SIGINT)  # as a terminal does: to all of them
    assert program.wait(60) == 130
    assert program.stderr.read() == ""
    assert all_gone(workers)
    assert len(list((tmp_path / "begun").iterdir())) == 2


CLOSING = """
import os, signal, sys, threading, time
from robocas_ms3.core.processes import uninterrupted
def other():
    started.set()
    time.sleep(60)
started = threading.Event()
threading.Thread(target=other, daemon=True).start()
started.wait()
try:
    with uninterrupted():
        os.kill(os.getpid(), signal.{name})  # the other thread gets it
        time.sleep(0.3)
        print("done", flush=True)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_what_must_not_be_interrupted_is_not_though_another_thread_gets_the_signal(name):
    handler = "signal.signal(signal.SIGTERM, signal.default_int_handler)\n" if name == "SIGTERM" else ""
    program = CLOSING.format(name=name).replace("started = ", handler + "started = ")
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    words = [sys.executable, "-c", program]
    found = subprocess.run(words, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert (found.stdout.split(), found.stderr) == (["done", "interrupted"], "")


def test_a_process_that_nobody_ended_does_not_keep_its_program(tmp_path):
    (tmp_path / "begun").mkdir()
    forgets = PROGRAM[: PROGRAM.index("        with Pool")] + FORGETS + PROGRAM[PROGRAM.index("    except") :]
    (tmp_path / "program.py").write_text(forgets.replace("time.sleep(60)", "pass"))
    with begin(tmp_path) as program:
        try:
            assert (program.communicate(timeout=60)[1], program.returncode) == ("", 0)
        finally:
            program.kill()


FORGETS = """        from robocas_ms3.core.processes.child import Child
        child = Child(partial(Calls, wait), 1.0)
        child.do(0, 60)
"""
