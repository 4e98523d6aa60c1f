"""What the network looks at, and what its loss counts."""

import math

import pytest
import torch

from robocas_ms3.baselines.rt1.transformer import looked_at


def test_who_looks_at_whom():
    """Two frames of two image tokens and two that are said: a token sees image tokens before it, and itself if one."""
    assert looked_at(2, 2, 2).int().tolist() == [
        [1, 0, 0, 0, 0, 0, 0, 0],
        [1, 1, 0, 0, 0, 0, 0, 0],
        [1, 1, 0, 0, 0, 0, 0, 0],
        [1, 1, 0, 0, 0, 0, 0, 0],
        [1, 1, 0, 0, 1, 0, 0, 0],
        [1, 1, 0, 0, 1, 1, 0, 0],
        [1, 1, 0, 0, 1, 1, 0, 0],
        [1, 1, 0, 0, 1, 1, 0, 0],
    ]


@pytest.mark.parametrize("frame", [0, 3, 5])
@pytest.mark.parametrize("view", [0, 1])
def test_a_frame_sees_no_later_one(model, batch, frame, view):
    before = model.logits(batch)
    batch["rgb"][:, frame, view] = 255 - batch["rgb"][:, frame, view]
    after = model.logits(batch)
    assert before.shape == (2, 6, 8, 256)
    assert torch.allclose(after[:, :frame], before[:, :frame], atol=1e-5)
    changed = (after - before)[:, frame:].abs().amax(dim=(2, 3))
    assert (changed > 1e-2).all()  # each frame from then on


def test_frames_of_one_picture_differ_by_their_place(model, batch):
    batch["rgb"][:] = batch["rgb"][:, :1].clone()
    logits = model.logits(batch)
    assert not torch.allclose(logits[:, 0], logits[:, 1], atol=1e-2)


def test_language_is_heard_and_samples_stay_apart(model, batch):
    before = model.logits(batch)
    batch["language"][1] = -batch["language"][1]
    after = model.logits(batch)
    assert torch.allclose(after[0], before[0], atol=1e-5)
    assert not torch.allclose(after[1], before[1], atol=1e-2)


def test_cameras_are_not_interchangeable(model, batch):
    before = model.logits(batch)
    batch["rgb"] = batch["rgb"].flip(2)
    assert not torch.allclose(model.logits(batch), before, atol=1e-2)


def test_loss_by_hand(model, batch, monkeypatch):
    """Logits that are 0, but for what is given here: cross entropy is log(256), or log(255 + e^x) - x."""
    logits = torch.zeros(2, 6, 8, 256)
    batch["action"][1, 5] = torch.tensor([-0.1, 0.0999, 0.0, 0.05, -0.05, 0.0999, 1.0])  # bins of 0.2 / 256
    for token, place in enumerate([0, 255, 128, 192, 64, 255, 255]):
        logits[1, 5, token, place] = 5.0
    logits[1, 5, 7, 1] = 3.0  # the end, as it is
    logits[0, 4, 7, 1] = 3.0  # where it is not
    monkeypatch.setattr(model, "logits", lambda _: logits)
    found = model(batch)
    plain, sure = math.log(256), math.log(255 + math.exp(5)) - 5
    end, no_end = math.log(255 + math.exp(3)) - 3, math.log(255 + math.exp(3))
    # 2 frames of the first sample and 6 of the second count, of 8 tokens each
    wanted = ((8 * 8 - 9) * plain + 7 * sure + end + no_end) / 64
    assert found["loss"].item() == pytest.approx(wanted, rel=1e-5)
    # zeros choose token 0: the end is not told, which is right in all frames but the one that says so wrongly
    assert found["terminate_accuracy"].item() == pytest.approx(7 / 8)
    others = [(0, 4), (0, 5), (1, 0), (1, 1), (1, 2), (1, 3), (1, 4)]
    shut = sum(int(batch["action"][place][6] == 0) for place in others)
    assert found["gripper_accuracy"].item() == pytest.approx((1 + shut) / 8)
    first = sum(int((batch["action"][place][:6] < -0.1 + 0.2 / 256).sum()) for place in others)  # hardly any
    assert found["action_accuracy"].item() == pytest.approx((7 + shut + first) / 56)


def test_padding_counts_nowhere(model, batch):
    found = model(batch)
    batch["action"][0, :4] = 0.07
    batch["terminate"][0, :4] = True
    assert all(torch.equal(value, found[name]) for name, value in model(batch).items())
    batch["action"][0, 4, :3] = 0.07
    assert not torch.equal(model(batch)["loss"], found["loss"])


def test_all_weights_learn(model, batch):
    model.train()(batch)["loss"].backward()
    still = [name for name, weight in model.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert still == []
