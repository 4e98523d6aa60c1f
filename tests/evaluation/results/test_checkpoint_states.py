"""States are flattened to rows."""

import torch

from robocas_ms3.evaluation.results.checkpoints import flatten_state


def test_a_state_is_a_row_per_env_in_the_order_of_its_entries():
    state = {
        "actors": {"cup": torch.tensor([[1.0, 2], [3, 4]])},
        "controller": {"arm": {"target": torch.tensor([[5.5], [6.5]])}},
        "task": {"stages": torch.tensor([[True, False], [False, True]])},
    }
    assert flatten_state(state).tolist() == [[1, 2, 5.5, 1, 0], [3, 4, 6.5, 0, 1]]
