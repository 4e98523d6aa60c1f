"""Loss of the networks of `keyframe`: padding, and labels with two equivalent values."""

import pytest
import torch

from robocas_ms3.baselines.keyframe.config import KeyframeConfig
from robocas_ms3.baselines.keyframe.gripper_crops import CELLS, CROP_CHANNELS, POSE_FEATURES
from robocas_ms3.baselines.keyframe.network import FIRST_NAME, HANDLE, KeyframeNetwork

SIZE, COUNT = 64, 2
CONFIG = KeyframeConfig(image_size=(SIZE, SIZE), crop_size=(SIZE, SIZE), channels=(8, 8, 8, 8, 8), decoder_channels=8)


@pytest.fixture
def network():
    torch.manual_seed(0)
    return KeyframeNetwork(CONFIG, {"names": ["apple", "box"]}).train()


def make_batch():
    generator = torch.Generator().manual_seed(0)
    cells, grasps = SIZE // 4, CONFIG.grasps
    return {
        "image": torch.randn(COUNT, 5, SIZE, SIZE, generator=generator),
        "label": torch.randint(FIRST_NAME + 2, (COUNT, cells, cells), generator=generator),
        "offset": torch.randn(COUNT, 3, cells, cells, generator=generator),
        "pull": torch.randn(COUNT, 9, generator=generator),
        "text": torch.randn(COUNT, 1, 384, generator=generator),
        "name": torch.tensor([[0], [1]]),
        "relation": torch.tensor([[0], [2]]),
        "crop": torch.randn(COUNT, grasps, CROP_CHANNELS, CELLS, CELLS, generator=generator),
        "pose": torch.randn(COUNT, grasps, POSE_FEATURES, generator=generator),
        "outcome": torch.tensor([[1.0, 0, -1, -1], [0, 1, 1, -1]]),
    }


def compute_loss(network, batch):
    torch.manual_seed(1)  # of dropout
    return network(batch)


def test_padding_changes_neither_the_loss_nor_the_statistics_of_the_norms(network):
    batch, states = make_batch(), []
    start = {name: value.clone() for name, value in network.state_dict().items()}
    for padding in (0.0, 100.0):
        network.load_state_dict(start)
        batch["crop"][batch["outcome"] < 0] = padding
        metrics = compute_loss(network, batch)
        states.append((metrics["loss"].item(), metrics["grasp"].tolist(), network.grasp.state_dict()))
        states[-1][2].update({name: value.clone() for name, value in states[-1][2].items()})
    (loss, grasp, state), (other_loss, other_grasp, other_state) = states
    assert loss == other_loss and grasp == other_grasp and grasp[1] == 5
    assert all(torch.equal(value, other_state[name]) for name, value in state.items())


def test_a_batch_without_grasps_has_a_loss(network):
    batch = make_batch() | {"outcome": torch.full((COUNT, CONFIG.grasps), -1.0)}
    metrics = compute_loss(network, batch)
    metrics["loss"].backward()
    assert torch.isfinite(metrics["loss"]) and metrics["grasp"].tolist() == [0, 0]
    assert network.segmentation.output.weight.grad.abs().sum() > 0


def test_both_directions_of_a_bar_are_correct(network):
    batch = make_batch()
    assert (batch["label"] == HANDLE).any()
    turned = {**batch, "pull": batch["pull"] * torch.tensor([1.0] * 6 + [-1.0] * 3)}
    other = {**batch, "pull": -batch["pull"]}
    pull, same, different = (compute_loss(network.eval(), one)["pull"][0].item() for one in (batch, turned, other))
    assert same == pytest.approx(pull) and different != pytest.approx(pull)
