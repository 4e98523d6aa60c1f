"""States are flattened to rows."""

import torch

from robocas_ms3.evaluation.checkpoints import flatten_state, unflatten_state


def test_a_state_is_a_row_per_env_in_the_order_of_its_entries():
    state = {
        "actors": {"cup": torch.tensor([[1.0, 2], [3, 4]])},
        "controller": {"arm": {"target": torch.tensor([[5.5], [6.5]])}},
        "task": {"stages": torch.tensor([[True, False], [False, True]])},
    }
    assert flatten_state(state).tolist() == [[1, 2, 5.5, 1, 0], [3, 4, 6.5, 0, 1]]


def test_rows_are_converted_back():
    state = {
        "controller": {"arm": {"target": torch.tensor([[1.5, 2], [3, 4]])}, "gripper": {}},
        "task": {"stages": torch.tensor([[True, False], [False, True]])},
        "step": torch.tensor([5, 6]),
    }
    again = unflatten_state(flatten_state(state), state)
    assert again["controller"]["arm"]["target"].tolist() == [[1.5, 2], [3, 4]]
    assert again["controller"]["gripper"] == {}
    assert again["task"]["stages"].dtype == torch.bool and again["task"]["stages"].tolist() == [[1, 0], [0, 1]]
    assert again["step"].tolist() == [5, 6]
