"""Network of rt1: attention, loss, tokens, and size in the paper's configuration."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.model import ActionBins, make_attention_mask, most_probable_tokens
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict_model import parse


def test_tokens_attend_to_earlier_image_tokens_only():
    """Two frames with one image token and two predicted tokens each."""
    first, second = [1, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0]
    assert make_attention_mask(2, 1, 2).int().tolist() == [first] * 3 + [second] * 3


@pytest.mark.parametrize(("frame", "view"), [(0, 0), (3, 1), (5, 0)])
def test_frames_do_not_attend_to_later_frames(model, batch, frame, view):
    before = model.logits(batch)
    batch["rgb"][:, frame, view] = 255 - batch["rgb"][:, frame, view]
    after = model.logits(batch)
    assert before.shape == (2, 6, 8, 256)
    assert torch.allclose(after[:, :frame], before[:, :frame], atol=1e-5)
    changed = (after - before)[:, frame:].abs().amax(dim=(2, 3))
    assert (changed > 1e-2).all()  # this frame and all later frames


def test_logits_depend_on_language_cameras_and_time_but_not_on_other_samples(model, batch):
    before = model.logits(batch)
    swapped = {**batch, "rgb": batch["rgb"].flip(2)}
    assert not torch.allclose(model.logits(swapped), before, atol=1e-2)
    still = {**batch, "rgb": batch["rgb"][:, :1].expand_as(batch["rgb"])}
    assert not torch.allclose(model.logits(still)[:, 0], model.logits(still)[:, 1], atol=1e-2)
    torch.manual_seed(7)  # evaluation draws no random numbers
    assert torch.equal(model.logits(batch), before)
    batch["language"][1] = -batch["language"][1]
    after = model.logits(batch)
    assert torch.allclose(after[0], before[0], atol=1e-5)
    assert not torch.allclose(after[1], before[1], atol=1e-2)


def test_loss(model, batch, monkeypatch):
    """Logits are 0 except for some: the cross entropy is log(256), or log(255 + e^x) - x."""
    logits = torch.zeros(2, 6, 8, 256)
    batch["action"][1, 5] = torch.tensor([-0.1, 0.0999, 0.0, 0.05, -0.05, 0.0999, 1.0])  # bins of 0.2 / 256
    for token, place in enumerate([0, 255, 128, 192, 64, 255, 255]):
        logits[1, 5, token, place] = 5.0
    logits[1, 5, 7, 1] = 3.0  # terminate token, correct
    logits[0, 4, 7, 1] = 3.0  # terminate token, wrong
    monkeypatch.setattr(model, "logits", lambda _: logits)
    found = model(batch)
    plain, sure = math.log(256), math.log(255 + math.exp(5)) - 5
    end, no_end = math.log(255 + math.exp(3)) - 3, math.log(255 + math.exp(3))
    # 2 frames of the first sample and 6 of the second count, of 8 tokens each
    wanted = ((8 * 8 - 9) * plain + 7 * sure + end + no_end) / 64
    assert found["loss"].item() == pytest.approx(wanted, rel=1e-5)
    # argmax of zeros is token 0: no termination, correct in all frames except the two set above
    assert found["terminate_accuracy"].item() == pytest.approx(7 / 8)
    others = [(0, 4), (0, 5), (1, 0), (1, 1), (1, 2), (1, 3), (1, 4)]
    shut = sum(int(batch["action"][place][6] == 0) for place in others)
    assert found["gripper_accuracy"].item() == pytest.approx((1 + shut) / 8)
    first = sum(int((batch["action"][place][:6] < -0.1 + 0.2 / 256).sum()) for place in others)  # few
    assert found["action_accuracy"].item() == pytest.approx((7 + shut + first) / 56)


def test_padding_does_not_count(model, batch):
    found = model(batch)
    batch["action"][0, :4] = 0.07
    batch["terminate"][0, :4] = True
    assert all(torch.equal(value, found[name]) for name, value in model(batch).items())
    batch["action"][0, 4, :3] = 0.07
    assert not torch.equal(model(batch)["loss"], found["loss"])


def test_every_weight_is_learned(model, batch):
    model.train()(batch)["loss"].backward()
    still = [name for name, weight in model.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert still == []


LOW, HIGH = [-0.02, -0.1, 0.0, -0.5, -1.0, 0.3], [0.06, 0.1, 0.4, 0.0, 1.0, 0.7]


@given(
    st.lists(st.floats(0, 1), min_size=7, max_size=7),
    st.lists(st.tuples(st.floats(-2, 2), st.floats(1e-3, 2)), min_size=6, max_size=6),
    st.integers(2, 256),
)
def test_decoding_inverts_encoding_to_half_a_bin(shares, ranges, count):
    low, span = torch.tensor([*[low for low, _ in ranges], 0.0]), torch.tensor([*[span for _, span in ranges], 1.0])
    bins = ActionBins(low[:6].tolist(), (low + span)[:6].tolist(), count)
    action = low + torch.tensor(shares) * span
    tokens = bins.encode(action)
    assert tokens.dtype == torch.int64
    assert ((tokens >= 0) & (tokens < count)).all()
    assert ((bins.decode(tokens) - action).abs() <= 0.5 * span / count + 1e-6).all()  # 1e-6: float32 near 2
    assert torch.equal(bins.encode(bins.decode(tokens)), tokens)


def test_bins():
    bins = ActionBins(LOW, HIGH, 4)
    # bins of 0.02 from -0.02, 0.05 from -0.1; beyond 0.4, before -0.5; bins of 0.5 from -1, 0.1 from 0.3, 0.25 from 0
    action = torch.tensor([0.025, 0.0, 0.5, -0.7, 0.99, 0.65, 1.0])
    assert bins.encode(action).tolist() == [2, 2, 3, 0, 3, 3, 3]
    wanted = [0.03, 0.025, 0.35, -0.4375, 0.75, 0.65, 0.875]
    assert torch.allclose(bins.decode(torch.tensor([2, 2, 3, 0, 3, 3, 3])), torch.tensor(wanted))


def test_bins_of_the_gripper_and_of_an_axis_without_motion():
    bins = ActionBins(LOW, HIGH, 256)
    tokens = bins.encode(torch.tensor([[0.0] * 7, [0.0] * 6 + [1.0]]))
    assert tokens[:, 6].tolist() == [0, 255]
    assert bins.decode(tokens)[:, 6].tolist() == [0.5 / 256, 255.5 / 256]
    fixed = ActionBins([0.1] * 6, [0.1] * 6, 256)
    tokens = fixed.encode(torch.tensor([0.1, 0.0, 0.2, 0.1, 0.1, 0.1, 1.0]))
    assert torch.allclose(fixed.decode(tokens)[:6], torch.full((6,), 0.1))


def test_termination_is_predicted_by_two_logits():
    logits = torch.zeros(8, 5)
    logits[:, 4] = 3.0
    logits[7, :2] = torch.tensor([1.0, 2.0])
    assert most_probable_tokens(logits).tolist() == [4] * 7 + [1]
    logits[7, 0] = 2.5
    assert most_probable_tokens(logits).tolist() == [4] * 7 + [0]


@pytest.fixture(scope="module")
def paper():
    """Return the paper's network on the meta device, without computation."""
    facts = {"action_low": [-0.1] * 6, "action_high": [0.1] * 6}
    with torch.device("meta"):
        return BASELINE.model(RT1Config(), facts).eval()


def test_size_of_the_network_of_the_paper(paper):
    """Two encoders of EfficientNet-B3 without its classifier, with FiLM, TokenLearner and projection; a transformer."""
    encoder = paper.encoders[0]
    counts = [sum(weight.numel() for weight in part.parameters()) for part in (encoder.net, encoder, paper)]
    assert counts == [10_696_232, 14_689_440, 2 * 14_689_440 + 19_391_232]
    assert len(encoder.films) == 26
    with torch.device("meta"):
        features = encoder.compute_features(torch.zeros(2, 3, 236, 320), torch.zeros(2, 384))
        tokens = paper.encode(torch.zeros(2, 2, 3, 256, 320, dtype=torch.uint8), torch.zeros(2, 384))
    assert features.shape == (2, 512, 8, 10)  # 236 x 320 halved five times: 118, 59, 30, 15, 8 rows
    assert tokens.shape == (2, 2 * 8, 512)


def test_a_changed_training_setting_keeps_the_other_defaults():
    changed = parse(RT1Config, {"train": {"steps": 300}}, TrainingError, where="rt1").train
    assert changed == RT1Config().train.model_copy(update={"steps": 300})
