"""Search for the smallest number of removals, with a toy scene that forked processes change."""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import permutations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.demos.difficulty.removal_search import RemovalScene, RemovalSearch
from robocas_ms3.demos.forked_processes import ForkedProcessError


class ToyHeap:
    """Target under objects; an object can be removed if no object lies on it.

    Args:
        blockers: objects that block the grasp of the target.
        on_top: (upper, lower) pairs of objects.
        objects: number of objects.
        first_way: ways below this one are impossible.
    """

    def __init__(self, blockers, on_top=(), objects=6, first_way=0):
        self.blockers, self.on_top = set(blockers), set(on_top)
        self.objects, self.first_way = set(range(objects)), first_way

    def can_remove(self, slot):
        return slot in self.objects and not any(lower == slot for upper, lower in self.on_top if upper in self.objects)

    def remove(self, slot, way):
        if way < self.first_way or not self.can_remove(slot):
            raise PlanningError("remove", "blocked")
        self.objects.discard(slot)

    def make_scene(self, ways=1):
        return RemovalScene(
            list_obstacles=lambda: sorted(self.objects),
            count_blockers=lambda: len(self.blockers & self.objects),
            ways=ways,
            remove=self.remove,
            can_grasp=lambda: not self.blockers & self.objects,
        )


def search(heap, max_removals=3, max_simulated=1000, ways=1):
    return RemovalSearch(heap.make_scene(ways), max_removals, max_simulated).run()


def test_target_that_can_be_grasped_needs_no_removal():
    result = search(ToyHeap([]))
    assert (result.removals, result.first, result.simulated, result.complete) == (0, (), 0, True)


@pytest.mark.parametrize(
    ("blockers", "on_top", "removals", "first"),
    [
        ([2], [], 1, (2,)),
        ([1, 4], [], 2, (1, 4)),
        ([1], [(3, 1)], 2, (3,)),  # 3 lies on 1
        ([1, 2], [(3, 1)], 3, (2, 3)),  # 2 and 3 in any order, 1 after 3
    ],
)
def test_smallest_number_and_first_objects(blockers, on_top, removals, first):
    heap = ToyHeap(blockers, on_top)
    result = search(heap)
    assert (result.removals, result.first, result.complete) == (removals, first, True)
    assert heap.objects == set(range(6)), "the scene of this process does not change"


def test_no_sequence_within_the_limit():
    result = search(ToyHeap([0, 1, 2]), max_removals=2)
    assert (result.removals, result.first, result.complete) == (None, (), True)


def test_early_end_is_reported():
    """With 3 simulated removals, neither the sequences nor the first objects are complete."""
    result = search(ToyHeap([4, 5]), max_simulated=3)
    assert (result.removals, result.complete, result.simulated) == (None, False, 3)
    result = search(ToyHeap([1]), max_simulated=2)
    assert (result.removals, result.first, result.complete) == (1, (1,), False)


def test_second_way_is_used_if_the_first_is_impossible():
    assert search(ToyHeap([2], first_way=1), ways=1).removals is None
    assert search(ToyHeap([2], first_way=1), ways=2).first == (2,)


def test_crashed_process_makes_the_search_incomplete():
    heap, process = ToyHeap([2]), os.getpid()

    def crash(slot, way):
        assert os.getpid() != process
        if slot == 0:
            os._exit(1)
        heap.remove(slot, way)

    scene = heap.make_scene()
    scene = RemovalScene(scene.list_obstacles, scene.count_blockers, 1, crash, scene.can_grasp)
    result = RemovalSearch(scene, 2, 100).run()
    assert (result.removals, result.first, result.complete) == (1, (2,), False)


def test_grasp_that_exceeds_its_time_limit_makes_the_search_incomplete():
    """Without object 0, no grasp has a result: it is not known whether one removal is enough."""
    heap = ToyHeap([2])

    def can_grasp():
        if 0 not in heap.objects:
            raise ForkedProcessError("time limit")
        return not heap.blockers & heap.objects

    result = RemovalSearch(replace(heap.make_scene(), can_grasp=can_grasp), 2, 100).run()
    assert (result.removals, result.first, result.complete) == (1, (2,), False)
    heap.objects.discard(0)
    with pytest.raises(ForkedProcessError):
        RemovalSearch(replace(heap.make_scene(), can_grasp=can_grasp), 2, 100).run()


@settings(max_examples=15, deadline=None)
@given(
    blockers=st.sets(st.integers(0, 3), max_size=2),
    on_top=st.sets(st.tuples(st.integers(0, 3), st.integers(0, 3)).filter(lambda pair: pair[0] > pair[1]), max_size=3),
)
def test_result_equals_that_of_all_permutations(blockers, on_top):
    solutions = []
    for count in range(4):
        for order in permutations(range(4), count):
            heap = ToyHeap(blockers, on_top, objects=4)
            if all(heap.can_remove(slot) and heap.objects.discard(slot) is None for slot in order):
                solutions += [order] if not heap.blockers & heap.objects else []
        if solutions:
            break
    result = search(ToyHeap(blockers, on_top, objects=4))
    assert result.removals == (len(solutions[0]) if solutions else None)
    assert set(result.first) == {order[0] for order in solutions if order}
