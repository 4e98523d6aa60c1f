"""Worker pool: order, errors, limits and crashes of worker processes."""

import errno
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from concurrent.futures import CancelledError
from functools import partial
from itertools import count

import pytest

from robocas_ms3.core.errors import AssetError, RobocasError, WorkerCrashError, WorkerStartError
from robocas_ms3.core.workers import FunctionWorker, Limits, WorkerPool

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))


class Counter:
    """Returns each task with the process and the number of tasks before; some tasks are slow, deadly or wrong."""

    def __init__(self, made=None, log=None):
        self.count, self.log = 0, log
        if made is not None:
            (made / str(os.getpid())).touch()

    def run(self, task):
        if task == "die":
            os.kill(os.getpid(), signal.SIGSEGV)
        if task == "die once" and not (self.log.parent / "died").exists():
            (self.log.parent / "died").touch()
            os.kill(os.getpid(), signal.SIGSEGV)
        if task == "terminate":
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
        self.count += 1
        if self.log is not None:
            with self.log.open("a") as file:
                file.write(f"{task}\n")
        return task, os.getpid(), self.count

    def close(self):
        self.count = -1


class CannotBeMade(Counter):
    def __init__(self):
        raise AssetError("nothing to work with")


def square(number):
    return number**2


def tasks_of(results):
    return [task for task, *_ in results]


def test_zero_workers_run_tasks_in_this_process():
    with WorkerPool(Counter, 0) as pool:
        assert list(pool.map(["a", "b"])) == [("a", os.getpid(), 1), ("b", os.getpid(), 2)]
    with WorkerPool(CannotBeMade, 0) as pool:
        assert list(pool.map([])) == []  # no worker is made


def test_each_process_makes_one_worker_which_runs_all_tasks(tmp_path):
    with WorkerPool(partial(Counter, tmp_path), 2) as pool:
        first, second = list(pool.map(map(str, range(9)))), list(pool.map(["x", "y"]))
    pids = {pid for _, pid, _ in first + second}
    assert tasks_of(first) == list(map(str, range(9)))
    assert tasks_of(second) == ["x", "y"]
    assert os.getpid() not in pids
    assert {path.name for path in tmp_path.iterdir()} == {str(pid) for pid in pids}
    assert len(pids) <= 2


def test_results_are_in_task_order_or_in_order_of_completion():
    tasks = [0.6, 0.0, 0.01, 0.02]
    with WorkerPool(Counter, 2) as pool:
        assert tasks_of(pool.map(tasks)) == tasks
        assert next(pool.map(tasks, ordered=False))[0] != 0.6
    with WorkerPool(partial(FunctionWorker, square), 2) as pool:
        squares = pool.map(count())
        assert [next(squares) for _ in range(20)] == [number**2 for number in range(20)]


def touch_or_wait(path):
    path.touch()
    while not path.with_name("9").exists() and path.name == "0":
        time.sleep(0.01)
    return path.name


def test_other_workers_continue_during_a_slow_task_with_a_limited_number_of_waiting_results(tmp_path):
    taken = []
    tasks = (taken.append(number) or tmp_path / f"{number}" for number in count())
    with WorkerPool(partial(FunctionWorker, touch_or_wait), 2, limits=Limits(seconds=60), retries=0) as pool:
        results = pool.map(tasks)
        assert [next(results), next(results)] == ["0", "1"]  # "0" ends after "9" has started
        assert len(taken) < 25


def test_a_pool_runs_later_tasks_after_ctrl_c():
    with WorkerPool(Counter, 1) as pool:
        pool.run("start")
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            pool.run(1.0)
        assert pool.run("later")[0] == "later"


class Result:
    def __init__(self, task):
        self.task = task


@pytest.mark.parametrize("ordered", [True, False])
def test_results_do_not_accumulate_in_memory(ordered):
    """A caller that is slower than the workers once kept all results in memory."""
    with WorkerPool(partial(FunctionWorker, Result), 1) as pool:
        results, given = pool.map(count(), ordered=ordered), []
        for _ in range(10):
            given.append(weakref.ref(next(results)))
            time.sleep(0.05)
        assert sum(result() is not None for result in given) <= 1


@pytest.mark.parametrize("num_workers", [0, 1])
def test_an_error_of_a_task_is_raised_and_the_worker_is_created_again(num_workers):
    with WorkerPool(Counter, num_workers) as pool:
        assert [pool.run("a")[2], pool.run("a")[2]] == [1, 2]
        with pytest.raises(AssetError) as caught:
            pool.run("fail")
        assert caught.value.where == "it"
        assert pool.run("a")[2] == 1


@pytest.mark.parametrize("num_workers", [0, 2])
def test_an_error_of_creating_the_worker_is_raised(num_workers):
    with WorkerPool(CannotBeMade, num_workers) as pool, pytest.raises(AssetError):
        list(pool.map(["a", "b", "c"]))


@pytest.mark.parametrize("ordered", [True, False])
def test_a_crash_affects_only_its_own_task(tmp_path, ordered):
    tasks = ["a", "b", "die", "c", "die", "d", "e"]
    make_worker = partial(Counter, log=tmp_path / "log")
    with WorkerPool(make_worker, 2, on_crash=lambda task, reason: (f"{task}d: {reason}", 0, 0)) as pool:
        found = tasks_of(pool.map(tasks, ordered=ordered))
    expected = ["a", "b", "died: SIGSEGV", "c", "died: SIGSEGV", "d", "e"]
    assert found == expected if ordered else sorted(found) == sorted(expected)
    done = (tmp_path / "log").read_text().split()
    assert sorted(done) == ["a", "b", "c", "d", "e"]  # none ran again


def test_a_crash_is_an_error_by_default():
    with WorkerPool(Counter, 1, retries=0) as pool:
        with pytest.raises(WorkerCrashError) as caught:
            list(pool.map(["die", "a"]))
        assert (caught.value.where, caught.value.found) == ("die", "SIGSEGV")


def run_pool_in_task(path):
    path.write_text(path.read_text() + "x")
    with WorkerPool(Counter, 1, retries=0) as pool:
        return pool.run("die")


def test_a_crash_in_a_pool_of_the_task_is_an_error_of_the_task(tmp_path):
    (tmp_path / "log").write_text("")
    make_worker = partial(FunctionWorker, run_pool_in_task)
    with WorkerPool(make_worker, 1, on_crash=lambda _, why: why) as pool, pytest.raises(WorkerCrashError) as caught:
        pool.run(tmp_path / "log")
    assert caught.value.where == "die"
    assert (tmp_path / "log").read_text() == "x"  # not tried again


@pytest.mark.parametrize(
    ("task", "limits", "reason"),
    [("hang", Limits(seconds=1.2), "time limit exceeded"), ("grow", Limits(memory_gb=0.3), "memory limit exceeded")],
)
def test_a_task_that_exceeds_a_limit_is_retried_once(tmp_path, caplog, task, limits, reason):
    def crashed(task, reason):
        return f"{task}: {reason}", 0, 0

    with WorkerPool(partial(Counter, log=tmp_path / "log"), 1, limits=limits, on_crash=crashed) as pool:
        results = list(pool.map(["a", task, "die once"]))
    assert tasks_of(results) == ["a", f"{task}: {reason}", "die once"]
    assert len(caplog.records) == 2  # each task has been tried again


def make_unpicklable(task):
    return lambda: task


def test_a_result_that_cannot_be_pickled_is_an_error():
    with WorkerPool(partial(FunctionWorker, make_unpicklable), 1) as pool, pytest.raises(Exception, match="pickle"):
        pool.run(1)


def test_a_worker_process_survives_the_calling_thread_a_sigterm_and_a_fork():
    with WorkerPool(Counter, 1) as pool:
        found = []
        thread = threading.Thread(target=lambda: found.append(pool.run("a")))
        thread.start()
        thread.join()
        time.sleep(0.2)
        process = found[0][1]
        assert pool.run("terminate") == ("terminate", process, 2)  # as a batch system ends all processes of a job
        pid = os.fork()
        if not pid:
            try:
                os._exit(0 if pool.run("b")[2] == 1 else 1)  # in a separate process
            finally:
                os._exit(2)
        assert os.waitpid(pid, 0)[1] == 0
        assert pool.run("b") == ("b", process, 3)


def test_stopping_a_pool_cancels_waiting_threads():
    errors = []

    def wait():
        try:
            pool.run("hang")
        except CancelledError as error:
            errors.append(error)

    pool = WorkerPool(Counter, 1)
    pool.run("a")
    threads = [threading.Thread(target=wait) for _ in range(2)]  # of a running task, and of a queued one
    for thread in threads:
        thread.start()
    time.sleep(0.2)
    pool.close()
    for thread in threads:
        thread.join(10)
    assert len(errors) == 2


def test_a_process_that_cannot_start_is_an_error(monkeypatch):
    def refuse(*args, **kwargs):
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    with WorkerPool(Counter, 1) as pool:
        with monkeypatch.context() as patch:
            patch.setattr("subprocess.Popen", refuse)
            with pytest.raises(RobocasError) as caught:
                pool.run("a")
            assert caught.value.found == os.strerror(errno.EAGAIN)
        assert pool.run("a")[0] == "a"


class TooLarge(Counter):
    def __init__(self):
        self.hog = bytearray(300 * 2**20)
        time.sleep(1000)


def test_a_process_over_the_memory_limit_before_its_first_task_is_a_start_error():
    with WorkerPool(TooLarge, 1, limits=Limits(memory_gb=0.2), on_crash=lambda task, reason: (task, 0, 0)) as pool:
        with pytest.raises(WorkerStartError) as caught:
            pool.run("a")
        assert caught.value.found == "memory limit exceeded"


PROGRAM = """
import time
from tqdm import tqdm
from robocas_ms3.core.workers import WorkerPool

class Busy:
    def run(self, task):
        list(tqdm([task], disable=False))
        time.sleep(1000 * task)
        return task

    def close(self):
        pass

with WorkerPool(Busy, 2) as pool:
    print(next(pool.map([0, 1, 1])))
"""


def test_a_program_from_standard_input_needs_no_main_guard_and_leaks_no_semaphores():
    env = {**os.environ, "PYTHONPATH": ROOT}
    done = subprocess.run([sys.executable, "-"], env=env, input=PROGRAM, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"
    assert "leaked" not in done.stderr  # the semaphore of a progress bar, about which Python would warn
