"""Where an attempt begins after one that failed. A counter stands for the simulator: it only sums up actions."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from robocas_ms3.planning.executor import CLOSED, OPEN, Executor


class Counter:
    """Its state is the list of actions since the reset."""

    def __init__(self) -> None:
        self.done: list[float] = []
        self.resets = 0

    def reset(self, seed: int):
        self.done, self.resets = [], self.resets + 1
        return None, {}

    def step(self, action: np.ndarray):
        self.done.append(float(action[0]))
        return None, 0, False, False, {}


class Simulated(Executor):
    base_env = property(lambda self: SimpleNamespace(control_mode="pd_joint_pos", control_timestep=0.05))


def executor() -> Simulated:
    made = Simulated(Counter(), seed=0)
    made.reset()
    return made


def act(made: Simulated, *values: float) -> None:
    for value in values:
        made._step(made._action(np.full(7, value)))


def test_without_a_checkpoint_all_is_undone():
    made = executor()
    act(made, 1, 2)
    made.go_back()
    assert made.env.done == []
    assert made.actions == []
    assert made.env.resets == 2


@pytest.mark.parametrize(("after", "kept"), [(0, []), (1, []), (2, [2]), (3, [2]), (9, [2, 4])])
def test_checkpoints_after_a_moment_are_forgotten(after, kept):
    made = executor()
    for _ in range(2):
        act(made, 1, 2)
        made.mark()
    made.forget_checkpoints(after)
    assert [checkpoint.length for checkpoint in made.checkpoints] == kept


def test_what_came_after_the_last_checkpoint_is_undone_and_the_rest_done_again():
    made = executor()
    made.label("find the object", "find it")
    made.gripper, made.facts["pushes"] = CLOSED, 1
    act(made, 1, 2)
    made.mark()
    made.label("move and grasp", "grasp it")
    made.gripper, made.facts["pushes"] = OPEN, 2
    act(made, 3, 4, 5)
    made.go_back()
    assert made.env.done == [1, 2]
    assert [float(action[0]) for action in made.actions] == [1, 2]
    assert [segment.goal_type for segment in made.segments] == ["find the object"]
    assert made.gripper == CLOSED
    assert made.facts == {"pushes": 1}
    assert made.at_checkpoint


def test_the_second_failure_gives_up_half_of_the_checkpoints():
    made = executor()
    for value in (1, 2, 3, 4):
        act(made, value)
        made.mark()
    for expected in ([1, 2, 3, 4], [1, 2], [1, 2], [1], [1], []):
        act(made, 9)
        made.go_back()
        assert made.env.done == expected


def test_a_checkpoint_from_which_nothing_can_be_done_is_given_up_at_once():
    made = executor()
    act(made, 1)
    made.mark()
    act(made, 2)
    made.mark()
    made.go_back()  # planning failed: no action since
    assert made.env.done == [1]


def test_what_took_too_long_gives_up_half_of_the_checkpoints_at_once():
    made = executor()
    for value in (1, 2, 3, 4):
        act(made, value)
        made.mark()
    act(made, 9)
    made.go_back(far=True)
    assert made.env.done == [1, 2]


def test_a_reset_forgets_the_checkpoints():
    made = executor()
    act(made, 1)
    made.mark()
    made.reset()
    assert not made.checkpoints
    assert not made.at_checkpoint
