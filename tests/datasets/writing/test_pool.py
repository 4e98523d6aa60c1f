"""Workers, in this process or in others."""

import os
from functools import partial
from pathlib import Path

import pytest
import torch

from robocas_ms3.datasets.writing.pool import do_all
from robocas_ms3.errors import DatasetError


class Looking:
    """Says what a process is like."""

    def do(self, task):
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
    def do(self, task):
        return os._exit(9) if task == 2 else task


def test_a_task_that_ends_its_process_is_one_clear_line_after_all_others():
    done, names = [], {2: "two"}
    with pytest.raises(DatasetError, match="out: these ended the process.*found two: exit code 9.*--resume"):
        for one in do_all(Deadly, [1, 2, 3], 1, Path("out"), renders=False, apart=True, name=names.__getitem__):
            done.append(one)
    assert done == [1, 3]


def test_elsewhere_torch_is_left_alone():
    assert list(look([1], 1, renders=False)) == [(1, os.getpid(), 2, None)]


def test_torch_gets_its_threads_back_after_a_failure():
    class Failing(Looking):
        def do(self, task):
            raise ValueError(task)

    with pytest.raises(ValueError, match="7"):
        list(do_all(Failing, [7], 1, Path("out")))
    assert torch.get_num_threads() == 2
