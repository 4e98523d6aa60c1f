"""Replay of stored actions from checkpoint to checkpoint: stages that a replay loses, without physics."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from robocas_ms3.evaluation.audit.stored_actions import CheckpointEnv, CheckpointLog
from robocas_ms3.evaluation.results.checkpoints import StateDeviation, flatten_state, unflatten_state
from robocas_ms3.evaluation.results.outcomes import Checkpoints

FAR = StateDeviation(0.1, 0.1, 0.1, 0.1)


class FakeEnv:
    """Env 1 lifts an object at step 3, returns to a state before the lift after step 5, and lifts it at ``again``."""

    num_envs = 2

    def __init__(self, again: int) -> None:
        self.again, self.elapsed = again, 0

    def step(self, actions: Any) -> tuple:
        self.elapsed += 1
        lifted = 3 <= self.elapsed <= 5 or self.elapsed >= self.again
        return None, {"picked_any": np.array([True, lifted]), "elapsed_steps": np.array([0, 2 * self.elapsed])}

    def call_each(self, name: str, calls: dict[int, tuple]) -> dict[int, Any]:
        assert name == "restore_checkpoint" and list(calls) == [1]
        return {1: (FAR, ["picked_any"] if self.elapsed == 5 else [])}


def run(again: int) -> CheckpointLog:
    policy: Any = SimpleNamespace(progress={})
    recorded = Checkpoints(np.array([5, 10, 12], np.int32), np.zeros((3, 4), np.float32))
    result: Any = SimpleNamespace(read_checkpoints=lambda episode: recorded, folder=Path())
    log = CheckpointLog()
    env = CheckpointEnv(FakeEnv(again), policy, result, log)
    for step in range(1, 13):
        policy.progress = {1: (7, step)}
        env.step(None)
    return log


def test_a_lost_stage_has_the_step_at_which_it_is_reached_again():
    assert run(9).lost_stages == {7: {"picked_any": (9, 18)}}
    assert run(6).lost_stages == {7: {"picked_any": (6, 12)}}  # in the next step
    assert run(99).lost_stages == {7: {"picked_any": None}}
    assert run(9).deviations == {7: [FAR] * 3}


def test_a_flat_state_is_read_back():

    state = {"controller": {"arm": torch.arange(3.0)[None]}, "task": {"a": torch.ones(1, 1), "b": torch.zeros(1, 2)}}
    row = np.append(flatten_state(state)[0].numpy(), 9)
    found = unflatten_state(state, row)
    assert found["controller"]["arm"].tolist() == [[0, 1, 2]]
    assert found["task"]["a"].tolist() == [[1]] and found["task"]["b"].tolist() == [[0, 0]]
