"""What the policy of search does when a move fails, on stand-ins."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.planning.decisions import StraightDecisions
from robocas_ms3.planning.solvers import search


@pytest.fixture
def arm(monkeypatch):
    """An arm whose actions are words; nothing is free, and the only move is to push something."""
    done: list[str] = []
    executor = SimpleNamespace(actions=done, facts={}, rehearse=lambda: None)
    decisions = StraightDecisions(lambda: len(done))
    arm = SimpleNamespace(target=0, executor=executor, choose=decisions.choose, planning=nullcontext)
    arm.begin_subgoal = lambda goal_type: None

    class Heap:
        cleared = uncovered = False
        visible = True
        moves_made = 0
        make = None

        def __init__(self, *_):
            pass

        def middle(self, slot):
            return None

        def moves(self):
            return ["push"]

        def check_surface(self):
            done.append("look at the surface")

    monkeypatch.setattr(search, "Heap", Heap)
    for name in ("look_at", "prepare_looks"):
        monkeypatch.setattr(search, name, lambda *_: None)
    monkeypatch.setattr(search, "_grasp", lambda *_: done.append("grasp") or True)
    monkeypatch.setattr(search, "carry_to_basket", lambda *_: done.append("carry"))
    monkeypatch.setattr(search, "release_into_basket", lambda *_: done.append("release"))
    return arm, Heap, done


def test_where_nothing_can_be_moved_the_target_is_grasped_as_it_lies(arm):
    arm, heap, done = arm

    def make(self, move):
        raise PlanningFailed("push", "no_room")

    heap.make = make
    search.attempt(arm)
    assert done == ["grasp", "carry", "look at the surface", "release"]
