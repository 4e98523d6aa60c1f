"""Differences of outcomes and checkpoints, exactly and from checkpoint to checkpoint."""

from dataclasses import replace

import numpy as np
import pytest

from robocas_ms3.evaluation.audit.differences import (
    list_deviations,
    list_differences,
    list_large_differences,
    list_state_differences,
)
from robocas_ms3.evaluation.audit.stored_actions import NO_ACTIONS_LEFT
from robocas_ms3.evaluation.results.checkpoints import StateDeviation
from robocas_ms3.evaluation.results.outcomes import NO_CHECKPOINTS, Checkpoints, MovedObject, Outcome, Retrieval

MOVED = [MovedObject("cup", 10, True, True), MovedObject("box", 12, True, True)]
RECORDED = Outcome(
    episode=0,
    task="search",
    config="heap",
    seed=1,
    split="test",
    success=True,
    success_at_end=True,
    success_v0=True,
    steps=100,
    seconds=5.0,
    failure_stage="",
    flags={"success": 100, "fail": None, "obstacles_cleared": 50, "picked_any": 39},
    flag_seconds={"success": 5.0, "fail": None, "obstacles_cleared": 2.5, "picked_any": 1.95},
    measures={"path_length": 1.0, "contact_impulse": 100.0, "disturbed_most": 2, "fallen": 0},
    retrieval=Retrieval(MOVED, ["cup", "box"], 0, 1.0),
)


def at_end(step):
    """Return the recorded outcome with a success at a step."""
    flags, seconds = RECORDED.flags | {"success": step}, RECORDED.flag_seconds | {"success": step / 20}
    return replace(RECORDED, steps=step, seconds=step / 20, flags=flags, flag_seconds=seconds)


def with_picked(step):
    return replace(RECORDED, flags=RECORDED.flags | {"picked_any": step})


def with_measures(**values):
    return replace(RECORDED, measures=RECORDED.measures | values)


def with_cleared(step):
    return replace(RECORDED, flags=RECORDED.flags | {"obstacles_cleared": step})


def with_moved(*moved):
    return replace(RECORDED, retrieval=Retrieval(list(moved), ["cup", "box"], 0, 0.5))


@pytest.mark.parametrize(
    ("replayed", "is_large"),
    [
        (RECORDED, False),
        (at_end(120), False),
        (at_end(121), True),
        (replace(RECORDED, success=False), True),
        (replace(RECORDED, success_v0=False), True),
        (replace(at_end(101), success_v0=False), False),
        (replace(RECORDED, flags={**RECORDED.flags, "success": None}), True),
        (replace(RECORDED, flags={**RECORDED.flags, "fail": 100}), True),
        (with_picked(19), False),
        (with_picked(18), True),
        (with_picked(None), True),
        (with_measures(path_length=1.02), False),
        (with_measures(path_length=1.03), True),
        (with_measures(contact_impulse=76.0), False),
        (with_measures(contact_impulse=74.0), True),
        (with_measures(fallen=1), False),
        (with_measures(fallen=2), True),
        (with_moved(*reversed(MOVED)), False),
        (with_moved(MOVED[0]), False),
        (with_moved(), True),
        (with_moved(MOVED[0], replace(MOVED[1], step=33)), False),
        (with_cleared(10), False),
        (replace(RECORDED, retrieval=replace(RECORDED.retrieval, needed=["cup"])), True),
        (replace(RECORDED, retrieval=None), True),
        (replace(RECORDED, seed=2), True),
    ],
)
def test_small_differences_are_those_that_another_processor_explains(replayed, is_large):
    assert bool(list_large_differences(RECORDED, replayed, period=20)) == is_large
    assert bool(list_differences(RECORDED, replayed)) == (replayed != RECORDED)


def test_an_error_of_the_policy_ends_the_stored_actions():
    failed = {"success": False, "success_at_end": False, "success_v0": False, "failure_stage": "error"}
    recorded = replace(RECORDED, **failed, error="lost connection")
    replayed = replace(recorded, error=NO_ACTIONS_LEFT)
    assert list_differences(recorded, replayed) == list_large_differences(recorded, replayed, 20) == []
    assert list_differences(recorded, replace(recorded, error="")) != []


def test_recorded_states_are_compared():
    states = np.arange(6, dtype=np.float32).reshape(3, 2)
    recorded = Checkpoints(np.array([20, 40, 50], np.int32), states)
    assert list_state_differences(recorded, recorded) == []
    assert list_state_differences(NO_CHECKPOINTS, recorded) == []
    changed = states.copy()
    changed[1, 1] += 1e-6 + 3e-7
    assert list_state_differences(recorded, recorded._replace(states=changed)) != []
    assert list_state_differences(recorded, Checkpoints(recorded.steps[:2], states[:2])) != []


@pytest.mark.parametrize(
    ("targets", "is_far"),
    [
        ([0.0] * 10, False),
        ([0.009] * 10, False),
        ([0.09, 0.02, 0.02] + [0.0] * 7, False),  # 30 % of the checkpoints may be more than 1 cm away
        ([0.02] * 4 + [0.0] * 6, True),
        ([0.14] + [0.0] * 9, False),
        ([0.16] + [0.0] * 9, True),
        ([0.05], False),  # one checkpoint is always allowed
        ([0.05, 0.05], True),
    ],
)
def test_deviations_of_the_target_are_limited(targets, is_far):
    deviations = [StateDeviation(one, one, 0.0, 0.0) for one in targets]
    assert bool(list_deviations(make_checkpoints(len(targets)), deviations, 20)) == is_far


@pytest.mark.parametrize(
    ("deviation", "is_far"),
    [
        ((0.0, 0.4, 0.0, 0.16), False),
        ((0.0, 0.6, 0.0, 0.0), True),
        ((0.0, 0.0, 0.09, 0.0), False),
        ((0.0, 0.0, 0.11, 0.0), True),
        ((0.0, 0.4, 0.0, 0.17), True),  # 0.51 m at three checkpoints
        ((0.0, 0.0, 0.0, np.nan), True),
    ],
)
def test_deviations_of_other_objects_and_joints_are_limited(deviation, is_far):
    deviations = [StateDeviation(*deviation)] * 3
    assert bool(list_deviations(make_checkpoints(3), deviations, 20)) == is_far


@pytest.mark.parametrize(("joint", "is_far"), [(0.0049, False), (0.024, False), (0.026, True)])
def test_the_sum_of_the_deviations_of_joints_is_limited(joint, is_far):
    deviations = [StateDeviation(0.0, 0.0, joint, 0.0)] * 20
    assert bool(list_deviations(make_checkpoints(20), deviations, 20)) == is_far


def make_checkpoints(count):
    return Checkpoints(np.arange(1, count + 1, dtype=np.int32) * 20, np.zeros((count, 4), np.float32))


@pytest.mark.parametrize(("steps", "fits"), [([20, 40, 50], True), ([20], True), ([50], False), ([20, 50], False)])
def test_no_checkpoint_may_be_left_out(steps, fits):
    checkpoints = Checkpoints(np.array(steps, np.int32), np.zeros((len(steps), 4), np.float32))
    assert (list_deviations(checkpoints, [StateDeviation(0.0, 0.0, 0.0, 0.0)] * len(steps), 20) == []) == fits
