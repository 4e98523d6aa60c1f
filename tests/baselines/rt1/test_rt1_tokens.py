"""Actions as tokens, and what is told of the end."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from robocas_ms3.baselines.rt1.model import chosen
from robocas_ms3.baselines.rt1.tokens import ActionBins

LOW, HIGH = [-0.02, -0.1, 0.0, -0.5, -1.0, 0.3], [0.06, 0.1, 0.4, 0.0, 1.0, 0.7]


@given(
    st.lists(st.floats(0, 1), min_size=7, max_size=7),
    st.lists(st.tuples(st.floats(-2, 2), st.floats(1e-3, 2)), min_size=6, max_size=6),
    st.integers(2, 256),
)
def test_a_number_within_its_range_comes_back_within_half_a_bin(shares, ranges, count):
    low, span = torch.tensor([*[low for low, _ in ranges], 0.0]), torch.tensor([*[span for _, span in ranges], 1.0])
    bins = ActionBins(low[:6].tolist(), (low + span)[:6].tolist(), count)
    action = low + torch.tensor(shares) * span
    tokens = bins.encode(action)
    assert tokens.dtype == torch.int64
    assert ((tokens >= 0) & (tokens < count)).all()
    assert ((bins.decode(tokens) - action).abs() <= 0.5 * span / count + 1e-6).all()  # 1e-6: float32 near 2
    assert torch.equal(bins.encode(bins.decode(tokens)), tokens)


def test_bins_by_hand():
    bins = ActionBins(LOW, HIGH, 4)
    # bins of 0.02 from -0.02, 0.05 from -0.1; beyond 0.4, before -0.5; bins of 0.5 from -1, 0.1 from 0.3, 0.25 from 0
    action = torch.tensor([0.025, 0.0, 0.5, -0.7, 0.99, 0.65, 1.0])
    assert bins.encode(action).tolist() == [2, 2, 3, 0, 3, 3, 3]
    wanted = [0.03, 0.025, 0.35, -0.4375, 0.75, 0.65, 0.875]
    assert torch.allclose(bins.decode(torch.tensor([2, 2, 3, 0, 3, 3, 3])), torch.tensor(wanted))


def test_the_gripper_is_open_or_closed_by_its_first_and_last_bin():
    bins = ActionBins(LOW, HIGH, 256)
    tokens = bins.encode(torch.tensor([[0.0] * 7, [0.0] * 6 + [1.0]]))
    assert tokens[:, 6].tolist() == [0, 255]
    assert bins.decode(tokens)[:, 6].tolist() == [0.5 / 256, 255.5 / 256]


def test_an_axis_that_never_moves_stays():
    bins = ActionBins([0.1] * 6, [0.1] * 6, 256)
    tokens = bins.encode(torch.tensor([0.1, 0.0, 0.2, 0.1, 0.1, 0.1, 1.0]))
    assert torch.allclose(bins.decode(tokens)[:6], torch.full((6,), 0.1))


def test_the_end_is_told_by_its_own_two_logits():
    logits = torch.zeros(8, 5)
    logits[:, 4] = 3.0
    logits[7, :2] = torch.tensor([1.0, 2.0])
    assert chosen(logits).tolist() == [4] * 7 + [1]
    logits[7, 0] = 2.5
    assert chosen(logits).tolist() == [4] * 7 + [0]
