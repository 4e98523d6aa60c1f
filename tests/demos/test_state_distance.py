import numpy as np
import pytest
import torch

from robocas_ms3.demos.replay import state_distance


def state(cube, cup=(0.0, 0.0), robot=(0.0, 0.0)):
    return {"actors": {"cube": np.array(cube), "cup": np.array(cup)}, "articulations": {"robot": np.array(robot)}}


def tensors(state):
    return {kind: {name: torch.tensor(value)[None] for name, value in of.items()} for kind, of in state.items()}


def test_the_greatest_difference_of_any_number():
    assert state_distance(tensors(state((1.0, 2.0), robot=(0.0, -0.5))), state((1.25, 2.0))) == 0.5


@pytest.mark.parametrize("where", [{"cube": (np.nan, 0.0)}, {"cup": (0.0, np.nan)}, {"robot": (np.nan, 1.0)}])
@pytest.mark.parametrize("swapped", [False, True])
def test_a_number_that_is_none_is_no_small_difference(where, swapped):
    sides = tensors(state(**{"cube": (0.0, 0.0), **where})), state((9.0, 0.0))
    if swapped:
        sides = tensors(sides[1]), state(**{"cube": (0.0, 0.0), **where})
    assert np.isnan(state_distance(*sides))
