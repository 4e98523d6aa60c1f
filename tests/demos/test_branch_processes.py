"""Forked decisions with killed, crashing, slow, interrupted and printing processes."""

from __future__ import annotations

import faulthandler
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from branch_notes import Notes

from robocas_ms3.core.errors import PlanningError, RobocasError
from robocas_ms3.core.remote_errors import RemoteTraceback
from robocas_ms3.demos import branches
from robocas_ms3.demos.branches import ForkedDecisions
from robocas_ms3.demos.forked_processes import ForkedProcessCrashError, find_reason_not_to_fork, run_in_forked_process
from robocas_ms3.planning.decisions import SearchLimits


def children() -> set[int]:
    return {int(pid) for pid in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()}


def forked(decide, notes=None):
    notes = notes or Notes()
    runner = ForkedDecisions(notes)
    before = children()
    ended = runner.run(lambda: decide(runner))
    assert children() == before, "no child is left, and no zombie"
    return ended, notes


@pytest.mark.parametrize("signal_", [signal.SIGSEGV, signal.SIGKILL])
def test_crashed_candidate_is_played_once_more_and_then_skipped(signal_, tmp_path):
    def play(letter):
        with (tmp_path / "played").open("a") as file:
            file.write(letter)
        if letter == "a":
            faulthandler.disable()  # the crash is intended: print no traceback
            os.kill(os.getpid(), signal_)
        return 0.0

    def decide(runner):
        assert runner.choose("ab", play) == "b"

    ended, notes = forked(decide)
    assert ended
    assert notes.texts == []  # the episode never continued from it
    assert (tmp_path / "played").read_text() == "aab"


def test_crash_after_the_decision_is_a_failed_attempt():
    def decide(runner):
        if runner.choose("ab", lambda letter: 0.0) == "a":
            faulthandler.disable()  # the crash is intended: print no traceback
            os.kill(os.getpid(), signal.SIGSEGV)

    ended, notes = forked(decide)
    assert ended
    assert notes.texts == ["branch: crashed"]


@pytest.mark.parametrize("moment", ["it plays", "it continues", "it waits"])
def test_child_killed_once_does_not_change_the_episode(tmp_path, moment):
    """Three candidates are compared, b is the best. Its process or that of a later decision is killed once."""

    def kill_once(when):
        if when == moment and not (tmp_path / "killed").exists():
            (tmp_path / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)

    def kill_waiting(letter):
        if moment == "it waits" and letter == "c" and not (tmp_path / "killed").exists():
            (tmp_path / "killed").touch()
            os.kill(int((tmp_path / "b").read_text()), signal.SIGKILL)

    def play(letter):
        (tmp_path / letter).write_text(str(os.getpid()))
        if letter == "b":
            kill_once("it plays")
        kill_waiting(letter)
        return {"a": 1.0, "b": 3.0, "c": 2.0}[letter]

    def decide(runner):
        first = runner.choose("abc", play, SearchLimits(max_compared_candidates=3))
        second = runner.choose("abc", lambda letter: 0.0)
        if second == "b":
            kill_once("it continues")
        if (first, second) != ("b", "c"):
            raise PlanningError("end", first + second)
        (tmp_path / "outcome").write_text(first + second)

    ended, notes = forked(decide)
    assert ended
    assert (tmp_path / "killed").exists()
    assert (tmp_path / "outcome").read_text() == "bc"
    assert notes.texts == ["end: ba", "end: bb"]


def test_child_that_exceeds_the_time_limit_is_killed(monkeypatch):
    monkeypatch.setattr(branches, "CANDIDATE_TIMEOUT", 4.0)

    def play(letter):
        if letter == "a":
            time.sleep(60)
        return 0.0

    def decide(runner):
        assert runner.choose("ab", play) == "b"

    assert forked(decide)[0]


def test_child_that_ends_during_a_message_has_crashed():
    def decide(runner):
        def play(letter):
            if letter == "a":
                # a length that no message of it reaches, as `multiprocessing.Connection` writes it
                os.write(runner._pipe.fileno(), (1 << 20).to_bytes(4, "big") + bytes(1000))
                os.kill(os.getpid(), signal.SIGKILL)
            return 0.0

        assert runner.choose("ab", play) == "b"

    ended, notes = forked(decide)
    assert (ended, notes.texts) == (True, [])


def test_broken_pipe_error_of_the_attempt_is_not_a_crash(tmp_path):
    def decide(runner):
        runner.choose("a", lambda letter: 0.0)
        with (tmp_path / "gone_on").open("a") as file:
            file.write("a")
        raise BrokenPipeError("a dropped mount")

    with pytest.raises(BrokenPipeError, match="a dropped mount"):
        forked(decide)
    assert (tmp_path / "gone_on").read_text() == "a"


def test_error_of_fork_names_a_fix(monkeypatch):
    def refuse():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuse)
    with pytest.raises(RobocasError, match="Resource temporarily unavailable.*--no-fork"):
        forked(lambda runner: runner.choose("a", lambda letter: 0.0))


def test_interrupt_during_the_last_message_ends_the_child(monkeypatch, tmp_path):
    class Interrupted(Connection):
        def send(self, obj):
            raise KeyboardInterrupt

    def decide(runner):
        def play(letter):
            if letter == "a":
                runner._pipe.__class__ = Interrupted
                raise PlanningError("play", "a")
            return 0.0

        assert runner.choose("ab", play) == "b"

    root = os.getpid()
    try:
        ended, notes = forked(decide)
    except KeyboardInterrupt:
        if os.getpid() == root:
            raise
        (tmp_path / "escaped").touch()
        os._exit(0)
    assert not (tmp_path / "escaped").exists()
    assert (ended, notes.texts) == (True, [])


def test_writing_threads_do_not_block_forked_processes(capfd):
    """Threads such as progress bars may hold locks of streams during a fork; the child does not have them."""
    over = threading.Event()

    def write():
        while not over.is_set():
            print("#" * 100, file=sys.stderr)

    def play(number):
        print("in a branch", file=sys.stderr)
        logging.getLogger("robocas_ms3").error("in a branch")
        raise PlanningError("play", str(number))

    def decide(runner):
        with pytest.raises(PlanningError, match="play: 19"):
            runner.choose(range(20), play)

    writers = [threading.Thread(target=write) for _ in range(2)]
    for writer in writers:
        writer.start()
    try:
        ended, notes = forked(decide)
    finally:
        over.set()
        for writer in writers:
            writer.join()
    assert (ended, notes.texts) == (True, [])
    assert capfd.readouterr().err.count("in a branch\n") >= 20


def test_error_of_a_child_has_its_traceback():
    def divide(letter):
        return 1 / 0

    def decide(runner):
        runner.choose("a", lambda letter: 0.0)
        runner.choose("a", lambda letter: 0.0)
        runner.choose("b", divide)  # three processes down

    with pytest.raises(ZeroDivisionError) as caught:
        forked(decide)
    assert isinstance(caught.value.__cause__, RemoteTraceback)
    text = str(caught.value.__cause__)
    assert text.count("in divide") == 1
    assert text.count("Traceback") == 1


def test_interrupt_in_a_new_child_ends_the_run(monkeypatch):
    set_up_forked_process, me = branches.set_up_forked_process, os.getpid()

    def interrupted(parent):
        set_up_forked_process(parent)
        raise KeyboardInterrupt

    def candidates():
        yield "a"
        monkeypatch.setattr(branches, "set_up_forked_process", interrupted)
        yield "b"

    def decide(runner):
        runner.choose(candidates(), lambda letter: 0.0, SearchLimits(max_compared_candidates=2))

    try:
        with pytest.raises(KeyboardInterrupt) as caught:
            forked(decide)
        assert isinstance(caught.value.__cause__, RemoteTraceback)
    finally:
        if os.getpid() != me:  # a child that takes itself for the root
            os._exit(1)


def test_output_of_children_is_printed_once_and_streams_may_be_missing(capfd, monkeypatch):
    def decide(runner):
        print("before", end="")
        runner.choose("ab", lambda letter: 0.0)

    assert forked(decide)[0]
    assert capfd.readouterr().out == "before"
    monkeypatch.setattr(sys, "stdout", None)  # as in a service
    monkeypatch.setattr(sys, "stderr", None)
    assert forked(lambda runner: runner.choose("a", lambda letter: 0.0))[0]


SLEEPER = """
import os, sys, time
from robocas_ms3.demos.branches import ForkedDecisions
from robocas_ms3.planning.decisions import SearchLimits
from robocas_ms3.core.remote_errors import RemoteTraceback
class Notes:
    has_no_attempts_left = False
    def add_failure(self, error): pass
    def copy_from(self, other): pass
def attempt():
    for _ in range(2):
        runner.choose("ab", lambda letter: 0.0, SearchLimits(max_compared_candidates=2))
    print(os.getpid(), flush=True)
    time.sleep(120)
runner = ForkedDecisions(Notes())
runner.run(attempt)
"""


def test_children_end_with_their_parent():
    with subprocess.Popen([sys.executable, "-c", SLEEPER], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        last = int(parent.stdout.readline())
        assert last != parent.pid
        parent.kill()
    deadline = time.monotonic() + 20
    while alive(last):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_reasons_not_to_fork(monkeypatch):
    assert find_reason_not_to_fork(renders=True) == "a renderer is open"
    assert find_reason_not_to_fork(renders=False) == ("" if sys.platform == "linux" else "this is not Linux")
    monkeypatch.setattr(sys, "platform", "darwin")
    assert find_reason_not_to_fork(renders=False) == "this is not Linux"


def test_function_in_a_forked_process_changes_only_the_child():
    notes = ["before"]

    def change():
        notes.append("child")
        return [*notes]

    before = children()
    assert run_in_forked_process(change) == ["before", "child"]
    assert notes == ["before"]
    assert children() == before


def test_error_of_a_function_in_a_forked_process_reaches_the_parent():
    with pytest.raises(ZeroDivisionError):
        run_in_forked_process(lambda: 1 // 0)


@pytest.mark.parametrize("crashes", [1, 2])
def test_function_whose_process_crashes_is_called_once_more(crashes, tmp_path):
    def crash():
        with (tmp_path / "calls").open("a") as file:
            file.write("x")
        if (tmp_path / "calls").stat().st_size <= crashes:
            os.kill(os.getpid(), signal.SIGKILL)
        return "result"

    if crashes == 1:
        assert run_in_forked_process(crash) == "result"
    else:
        with pytest.raises(ForkedProcessCrashError):
            run_in_forked_process(crash)
    assert (tmp_path / "calls").read_text() == "xx"
