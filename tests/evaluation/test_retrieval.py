"""Retrieval order in a heap: a target, a lid on the target, a cup on the lid, and a pear next to them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from robocas_ms3.evaluation.results.metrics import RetrievalTracker, find_objects_to_move
from robocas_ms3.evaluation.results.outcomes import Retrieval

TARGET, LID, CUP, PEAR = range(4)
NAMES = ("target", "lid", "cup", "pear")
OVER = torch.zeros(1, 4, 4)
OVER[0, LID, TARGET], OVER[0, CUP, LID], OVER[0, PEAR, CUP] = 0.5, 0.3, 0.05


class Heaps:
    """Fake search environment for `RetrievalTracker`: equal heaps at 20 Hz."""

    device, control_timestep = torch.device("cpu"), 0.05

    def __init__(self, count: int = 1) -> None:
        self.present, self.target_slot = torch.ones(count, 4, dtype=torch.bool), torch.full((count,), TARGET)
        self.disturbed = torch.zeros(count, 4, dtype=torch.bool)
        self.elapsed_steps = torch.zeros(count, dtype=torch.int32)

    def make_state(self, *, held: bool = False):
        return SimpleNamespace(disturbed=self.disturbed.numpy(), target_held=np.array([held] * len(self.disturbed)))

    def measure_pairwise_occlusion(self, envs):
        return OVER.repeat(len(envs), 1, 1)

    def measure_clutter(self, envs):
        return SimpleNamespace(obstacles=torch.zeros(len(envs), 4, dtype=torch.bool))


def record_of(moves: dict[int, int], held_at: int = 1000, steps: int = 200) -> np.ndarray:
    """Return the record if objects move at these control steps; two control steps per policy step."""
    heap: Any = Heaps()
    retrieval = RetrievalTracker(heap)
    retrieval.reset(torch.tensor([0]))
    for step in range(1, steps + 1):
        heap.elapsed_steps += 1
        for slot, at in moves.items():
            heap.disturbed[0, slot] |= step == at
        retrieval.update(heap.make_state(held=step == held_at))
        if step % 2 == 0:
            retrieval.end_step()
    return retrieval.compute_record()[0].numpy()


def test_objects_on_top_of_needed_objects_are_needed():
    assert find_objects_to_move(OVER[:, :, TARGET] >= 0.1, OVER >= 0.1).tolist() == [[False, True, True, False]]
    hemmed_in = torch.tensor([[False, False, False, True]])
    assert find_objects_to_move(hemmed_in, OVER >= 0.1).tolist() == [[False, False, False, True]]


def test_order_from_the_top_down_has_full_score():
    kept = record_of({CUP: 10, LID: 60, PEAR: 81})
    assert kept.tolist() == [[0, 0, 0], [30, 1, 1], [5, 1, 1], [41, 0, 0]]
    found = Retrieval.from_record(kept, NAMES, held_at=90, cleared=True)
    assert [move.object for move in found.moved] == ["cup", "lid", "pear"]
    assert [move.needed for move in found.moved] == [True, True, False]
    assert (found.needed, found.left, found.score) == (["lid", "cup"], 0, 0.6667)


@pytest.mark.parametrize("start", (20, 69, 132))
def test_objects_pushed_together_within_a_second_are_in_order(start):
    assert record_of({LID: start, CUP: start + 20})[LID].tolist() == [(start + 1) // 2, 1, 1]
    assert record_of({LID: start, CUP: start + 21})[LID][2] == 0


def test_order_from_below_or_without_moves_loses_score():
    assert record_of({LID: 20}).tolist()[LID] == [10, 1, 0]
    found = Retrieval.from_record(record_of({LID: 20}), NAMES, held_at=50, cleared=False)
    assert (found.left, found.score) == (1, 0.0)
    assert Retrieval.from_record(record_of({LID: 20}), NAMES, held_at=50, cleared=True).left == 0


def test_moves_after_the_target_was_held_do_not_count():
    found = Retrieval.from_record(record_of({CUP: 10, LID: 60}, held_at=60), NAMES, held_at=30, cleared=True)
    assert [move.object for move in found.moved] == ["cup"]


def test_moves_after_a_forgotten_grasp_count():
    heap: Any = Heaps()
    retrieval = RetrievalTracker(heap)
    retrieval.reset(torch.tensor([0]))
    retrieval.update(heap.make_state(held=True))
    retrieval.end_step()
    heap.disturbed[0, CUP] = True
    retrieval.update(heap.make_state())
    assert retrieval.compute_record()[0, CUP].tolist() == [0, 1, 0]
    retrieval.forget_grasp()
    retrieval.update(heap.make_state())
    assert retrieval.compute_record()[0, CUP, 0] == 2


def test_no_score_if_the_target_was_never_held():
    found = Retrieval.from_record(record_of({CUP: 10}), NAMES, held_at=None, cleared=False)
    assert (found.score, found.left, len(found.moved)) == (None, 0, 1)
    nothing = np.zeros((4, 3), np.int16)
    assert Retrieval.from_record(nothing, NAMES, held_at=5, cleared=True).score == 1.0


def test_envs_are_reset_independently():
    heap: Any = Heaps(2)
    retrieval = RetrievalTracker(heap)
    retrieval.reset(torch.tensor([0, 1]))
    heap.disturbed[:, CUP], heap.elapsed_steps[:] = True, 1
    retrieval.update(heap.make_state())
    retrieval.end_step()
    retrieval.reset(torch.tensor([1]))
    assert retrieval.compute_record()[:, CUP].tolist() == [[1, 1, 1], [0, 1, 0]]
