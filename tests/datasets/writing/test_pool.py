"""Workers, in this process or in others."""

import errno
import os
from functools import partial
from pathlib import Path

import pytest
import torch

from robocas_ms3.core.errors import DatasetError, IncompleteError, MissingExtraError
from robocas_ms3.datasets.writing.pool import do_all


class Looking:
    """Says what a process is like."""

    def run(self, task):
        return task, os.getpid(), torch.get_num_threads(), os.environ.get("LP_NUM_THREADS")

    def close(self):
        pass


@pytest.fixture(autouse=True)
def two_threads(monkeypatch):
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # of torch where it is new
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


look = partial(do_all, Looking, where=Path("out"))


def test_torch_has_one_thread_where_pictures_are_rendered():
    assert list(look([1, 2], 1)) == [(1, os.getpid(), 1, None), (2, os.getpid(), 1, None)]
    assert torch.get_num_threads() == 2
    others = list(look([1, 2, 3], 2))
    assert {task for task, *_ in others} == {1, 2, 3}
    assert os.getpid() not in {pid for _, pid, *_ in others}
    assert {(threads, rasteriser) for *_, threads, rasteriser in others} == {(1, "1")}


class Deadly(Looking):
    def run(self, task):
        return os._exit(9) if task == 2 else task


def test_a_task_that_ends_its_process_is_one_clear_line_after_all_others():
    done, names = [], {1: "one", 2: "two", 3: "three"}
    with pytest.raises(IncompleteError, match="out: 1 episode could.*.found two: its process died twice: exit code 9"):
        for one in do_all(Deadly, [1, 2, 3], 1, Path("out"), renders=False, apart=True, name=names.__getitem__):
            done.append(one)
    assert done == [1, 3]


class Picky(Looking):
    """Fails at odd tasks; what it works with is of no use afterwards."""

    spoilt = False

    def run(self, task):
        assert not self.spoilt
        if task % 2:
            self.spoilt = True
            raise LookupError(f"{task} is odd") if task % 3 else DatasetError(f"{task} is odd", fix="Don't.")
        return task


@pytest.mark.parametrize("processes", [1, 2])
def test_a_task_that_fails_costs_no_other(processes, caplog):
    look = partial(do_all, Picky, range(8), processes, Path("out"), renders=False, name="e{}".format, fix="Mend it.")
    done = []
    with pytest.raises(IncompleteError) as caught:
        for one in look():
            done.append(one)
    assert sorted(done) == [0, 2, 4, 6]
    assert caught.value.reasons == {
        "e1": "LookupError: 1 is odd", "e3": "3 is odd. Don't", "e5": "LookupError: 5 is odd",
        "e7": "LookupError: 7 is odd",
    }  # fmt: skip
    found = "; ".join(f"{name}: {why}" for name, why in caught.value.reasons.items())
    assert str(caught.value) == f"out: 4 episodes could not be written (found {found}). Mend it."
    assert "e7 could not be written" in caplog.text


def test_of_many_the_first_are_told():
    with pytest.raises(IncompleteError, match="found 1: [^;]*; 11: [^;]*; 13: [^;]*; 15: [^;]*; 3: [^;]*; and 3 more"):
        list(do_all(Picky, range(16), 1, Path("out"), renders=False))


@pytest.mark.parametrize(("tasks", "tried"), [([1], 1), ([1, 3], 2), ([1, 3, 5, 2], 3)])
def test_what_befalls_all_is_raised_as_it_is(tasks, tried):
    begun = []

    class Counting(Picky):
        def run(self, task):
            begun.append(task)
            return super().run(task)

    with pytest.raises(LookupError, match="1 is odd"):
        list(do_all(Counting, tasks, 1, Path("out"), renders=False))
    assert len(begun) == tried
    with pytest.raises(IncompleteError):  # where others are there already, it does not befall all
        list(do_all(Counting, tasks, 1, Path("out"), renders=False, begun=True))
    assert len(begun) == tried + len(tasks)


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "full"), FileNotFoundError(errno.ENOENT, "gone"), MissingExtraError("no extra")]
)
def test_what_is_wrong_with_the_machine_ends_it_at_once(error):
    class Failing(Looking):
        def run(self, task):
            if task == 2:
                raise error
            return task

    done = []
    with pytest.raises(type(error)):
        for one in do_all(Failing, [1, 2, 3], 1, Path("out"), renders=False):
            done.append(one)
    assert done == [1]


def test_elsewhere_torch_is_left_alone():
    assert list(look([1], 1, renders=False)) == [(1, os.getpid(), 2, None)]


def test_torch_gets_its_threads_back_after_a_failure():
    class Failing(Looking):
        def run(self, task):
            raise ValueError(task)

    with pytest.raises(ValueError, match="7"):
        list(do_all(Failing, [7], 1, Path("out")))
    assert torch.get_num_threads() == 2
