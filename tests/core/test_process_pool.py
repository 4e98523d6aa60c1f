"""The pool as every room uses it: order, errors, deaths of a worker."""

import errno
import math
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from itertools import count

import pytest

from robocas_ms3.core.errors import AssetError, RobocasError
from robocas_ms3.core.processes import Calls, Limits, Pool
from robocas_ms3.core.processes.child import Child


class Slow:
    """Says which process did a task and how many it had done; some tasks are slow, deadly or wrong."""

    def __init__(self, opened=None, log=None):
        self.done, self.log = 0, log
        if opened is not None:
            (opened / str(os.getpid())).touch()

    def do(self, task):
        if task == "die":
            os.kill(os.getpid(), signal.SIGSEGV)
        if task == "die once" and not (self.log.parent / "died").exists():
            (self.log.parent / "died").touch()
            os.kill(os.getpid(), signal.SIGSEGV)
        if task == "told to end":
            os.kill(os.getpid(), signal.SIGTERM)
        if task == "hang":
            time.sleep(1000)
        if task == "grow":
            hog = bytearray(600 * 2**20)
            time.sleep(1000)
            del hog
        if task == "fail":
            raise AssetError("no such thing", where="it")
        if isinstance(task, float):
            time.sleep(task)
        self.done += 1
        if self.log is not None:
            with self.log.open("a") as file:
                file.write(f"{task}\n")
        return task, os.getpid(), self.done

    def close(self):
        self.done = -1


class Unopened(Slow):
    def __init__(self):
        raise AssetError("nothing to work with")


def squared(number):
    return number**2


def tasks_of(results):
    return [task for task, *_ in results]


def test_one_process_is_this_one_and_opens_nothing_it_does_not_need():
    with Pool(Slow, 1) as pool:
        results = list(pool.do(["a", "b"]))
        worker = pool._worker
    assert results == [("a", os.getpid(), 1), ("b", os.getpid(), 2)]
    assert worker is not None and worker.done == -1  # closed
    with Pool(Unopened, 1) as pool:
        assert list(pool.do([])) == []


def test_each_process_opens_once_and_serves_all_that_is_asked_of_the_pool(tmp_path):
    with Pool(partial(Slow, tmp_path), 2) as pool:
        first, second = list(pool.do(list(map(str, range(9))))), list(pool.do(["x", "y"]))
    pids = {pid for _, pid, _ in first + second}
    assert sorted(tasks_of(first)) == list(map(str, range(9)))
    assert sorted(tasks_of(second)) == ["x", "y"]
    assert os.getpid() not in pids
    assert {path.name for path in tmp_path.iterdir()} == {str(pid) for pid in pids}
    assert len(pids) <= 2


def test_results_come_in_order_or_as_they_are_there_and_tasks_may_have_no_end():
    tasks = [0.6, 0.0, 0.01, 0.02]
    with Pool(Slow, 2) as pool:
        assert tasks_of(pool.do(tasks, in_order=True)) == tasks
        assert next(pool.do(tasks))[0] != 0.6
    with Pool(partial(Calls, squared), 2) as pool:
        squares = pool.do(count(), in_order=True)
        assert [next(squares) for _ in range(20)] == [number**2 for number in range(20)]


@pytest.mark.parametrize(("worker", "message"), [(Slow, "it: no such thing"), (Unopened, "nothing to work with")])
def test_an_error_of_a_task_or_of_opening_is_raised_as_it_is(worker, message):
    with pytest.raises(AssetError, match=message), Pool(worker, 2) as pool:
        list(pool.do(["fail", "fail", "fail"]))


@pytest.mark.parametrize("in_order", [True, False])
def test_a_death_costs_no_task_but_its_own(in_order):
    tasks = ["a", "b", "die", "c", "die", "d", "e"]
    with Pool(Slow, 2, died=lambda task, why: (f"{task}d", 0, 0)) as pool:
        found = tasks_of(pool.do(tasks, in_order=in_order))
    expected = ["a", "b", "died", "c", "died", "d", "e"]
    assert found == expected if in_order else sorted(found) == sorted(expected)


def test_what_was_done_before_a_death_is_not_done_again(tmp_path):
    tasks = [0.5, "fast", "fast too", "die"]
    with Pool(partial(Slow, log=tmp_path / "log"), 2, died=lambda task, why: (task, 0, 0)) as pool:
        assert tasks_of(pool.do(tasks, in_order=True)) == tasks
    done = (tmp_path / "log").read_text().split("\n")
    assert [done.count(task) for task in ("fast", "fast too")] == [1, 1]


def test_a_death_is_an_error_where_nothing_else_was_asked_for():
    with (
        pytest.raises(RobocasError, match="die: the process that was at this died .found SIGSEGV"),
        Pool(Slow, 2) as pool,
    ):
        list(pool.do(["die", "a"]))
    with pytest.raises(RobocasError, match="die: the process"), Pool(Slow, 1, here=False) as pool:
        list(pool.do(["die"]))  # not this one, though one is enough


@pytest.mark.parametrize(
    ("task", "limits", "why"),
    [("hang", Limits(seconds=1.2), "too slow"), ("grow", Limits(memory_gb=0.3), "too much memory")],
)
def test_a_task_that_takes_more_than_it_may_is_begun_again_once(tmp_path, caplog, task, limits, why):
    def died(task, why):
        return f"{task}: {why}", 0, 0

    with Pool(partial(Slow, log=tmp_path / "log"), 1, died=died, here=False, limits=limits) as pool:
        results = list(pool.do(["a", task, "die once"], in_order=True))
    assert tasks_of(results) == ["a", f"{task}: {why}", "die once"]
    said = "the process that was at this died"
    assert [record.getMessage() for record in caplog.records] == [
        f"{task}: {said} ({why}); it is begun again",
        f"die once: {said} (SIGSEGV); it is begun again",
    ]


def unsendable(task):
    return lambda: task


def test_a_result_that_cannot_be_sent_is_an_error():
    with pytest.raises(Exception, match="pickle"), Pool(partial(Calls, unsendable), 1, here=False) as pool:
        list(pool.do([1]))


def test_a_process_stays_when_the_thread_that_asked_for_it_ends():
    child = Child(Slow, math.inf)
    found = []
    thread = threading.Thread(target=lambda: found.append(child.do("a", 60)))
    thread.start()
    thread.join()
    time.sleep(0.2)
    assert child.do("b", 60) == ("b", found[0][1], 2)
    child.end()


def test_what_tells_a_whole_job_to_end_is_no_death():
    child = Child(Slow, math.inf)
    assert child.do("told to end", 60)[0] == "told to end"
    child.stop()
    child.wait(10)


def test_a_process_that_the_system_refuses_is_an_error_and_ends_nothing(monkeypatch):
    def refuse(process):
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    child = Child(Slow, math.inf)
    with monkeypatch.context() as patch:
        patch.setattr("multiprocessing.context.SpawnProcess.start", refuse)
        with pytest.raises(RobocasError, match="can't start another process .found Resource temporarily unavailable"):
            child.do("a", 60)
        child.stop()
        child.wait(0)
    with Pool(Slow, 1, here=False) as pool:
        assert tasks_of(pool.do(["a"])) == ["a"]


def test_a_fork_starts_processes_of_its_own():
    with Pool(Slow, 1, here=False) as pool:
        list(pool.do(["a"]))
        pid = os.fork()
        if not pid:
            child = Child(Slow, math.inf)
            try:
                os._exit(0 if child.do("b", 60)[0] == "b" else 1)
            finally:
                os._exit(2)
        assert os.waitpid(pid, 0)[1] == 0


class TooLarge(Slow):
    def __init__(self):
        self.hog = bytearray(300 * 2**20)
        time.sleep(1000)


def test_a_process_that_is_too_large_before_it_begins_blames_no_task():
    said = "a process ended before it could begin .found too much memory"
    limits = Limits(memory_gb=0.2)
    with pytest.raises(RobocasError, match=said), Pool(TooLarge, 1, here=False, limits=limits) as pool:
        list(pool.do(["a"]))


BUSY = """
import time
from tqdm import tqdm
from robocas_ms3.core.processes import Pool

class Busy:
    def do(self, task):
        list(tqdm([task], disable=False))
        time.sleep(1000 * task)
        return task

    def close(self):
        pass

if __name__ == "__main__":
    with Pool(Busy, 2) as pool:
        print(next(iter(pool.do([0, 1, 1]))))
"""


def test_what_is_killed_in_the_end_leaves_nothing_of_the_systems(tmp_path):
    """As a bar's lock, of which Python would warn when all is done."""
    (tmp_path / "busy.py").write_text(BUSY)
    done = subprocess.run([sys.executable, "busy.py"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"
    assert "leaked" not in done.stderr
