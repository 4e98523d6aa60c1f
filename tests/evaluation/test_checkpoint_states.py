"""States are flattened to rows and back."""

import torch

from robocas_ms3.evaluation.checkpoints import flatten_state, unflatten_state

STATE = {
    "actors": {"cup": torch.tensor([[1.0, 2], [3, 4]])},
    "controller": {"arm": {"target": torch.tensor([[5.5], [6.5]])}},
    "task": {"stages": torch.tensor([[True, False], [False, True]])},
}


def test_a_state_is_a_row_per_env_in_the_order_of_its_entries():
    assert flatten_state(STATE).tolist() == [[1, 2, 5.5, 1, 0], [3, 4, 6.5, 0, 1]]


def test_rows_give_the_state_with_its_types():
    found = unflatten_state(flatten_state(STATE), STATE)
    assert found["actors"]["cup"].equal(STATE["actors"]["cup"])
    assert found["controller"]["arm"]["target"].equal(STATE["controller"]["arm"]["target"])
    assert found["task"]["stages"].dtype == torch.bool and found["task"]["stages"].equal(STATE["task"]["stages"])
    assert list(found) == list(STATE)
