"""Checkpoints: whole or not there, of one thing only, and what is damaged is said."""

import re
import resource

import pytest
import torch

from robocas_ms3.baselines.training import checkpoints
from robocas_ms3.core.errors import TrainingError

ABOUT = {"baseline": "x", "version": "1", "dataset": "d"}


def test_there_and_back(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoints.save(path, {"a": torch.arange(3.0), "b": torch.tensor(2)}, {**ABOUT, "step": "7"})
    tensors, about = checkpoints.load(path, ABOUT)
    assert tensors["a"].tolist() == [0, 1, 2] and tensors["b"].item() == 2 and about["step"] == "7"
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.safetensors"]


def test_the_same_is_the_same_file(tmp_path):
    """safetensors itself has texts in any order."""
    path, about = tmp_path / "c.safetensors", {f"key{number}": "x" * number for number in range(20)}
    tensors = {"b": torch.arange(7, dtype=torch.uint8), "a": torch.arange(3.0), "c": torch.tensor(2)}
    made = set()
    for _ in range(5):
        checkpoints.save(path, tensors, about)
        made.add(path.read_bytes())
    assert len(made) == 1
    back, said = checkpoints.load(path, about)
    assert said == about and all(torch.equal(back[name], tensors[name]) for name in tensors)


@pytest.mark.parametrize("key", ABOUT)
def test_of_something_else(tmp_path, key):
    path = tmp_path / "c.safetensors"
    checkpoints.save(path, {"a": torch.zeros(1)}, ABOUT)
    with pytest.raises(TrainingError, match=f"another {key}"):
        checkpoints.load(path, {**ABOUT, key: "other"})


@pytest.mark.parametrize("content", [b"", b"abc", b"\xff" * 100])
def test_damaged(tmp_path, content):
    path = tmp_path / "c.safetensors"
    path.write_bytes(content)
    with pytest.raises(TrainingError, match="can't be read"):
        checkpoints.load(path, ABOUT)


def test_cut_off(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoints.save(path, {"a": torch.zeros(1000)}, ABOUT)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(TrainingError, match="can't be read"):
        checkpoints.load(path, ABOUT)


def test_none(tmp_path):
    with pytest.raises(TrainingError, match="no such file"):
        checkpoints.load(tmp_path / "c.safetensors", ABOUT)


@pytest.fixture
def little_room():
    """No file may be larger than a kilobyte: the system refuses what goes beyond, as where a disk is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_without_room_the_one_before_stays(tmp_path, little_room):
    path = tmp_path / "c.safetensors"
    checkpoints.save(path, {"a": torch.zeros(1)}, ABOUT)
    with pytest.raises(OSError, match=re.escape(str(path))):
        checkpoints.save(path, {"a": torch.ones(1000)}, ABOUT)
    assert checkpoints.load(path, ABOUT)[0]["a"].item() == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.safetensors"]


@pytest.mark.parametrize(
    ("tensors", "found"),
    [
        ({"weight": torch.zeros(2, 3)}, r"w, bias: .*expected \[2\], found none"),
        (
            {"weight": torch.zeros(2, 3), "bias": torch.zeros(2), "more": torch.zeros(1)},
            r"w, more: .*expected none, found \[1\]",
        ),
        (
            {"weight": torch.zeros(2, 4), "bias": torch.zeros(2)},
            r"w, weight: .*expected \[2, 3\], found \[2, 4\]",
        ),
    ],
)
def test_weights_of_another_model(tensors, found):
    with pytest.raises(TrainingError, match=found):
        checkpoints.load_weights(torch.nn.Linear(3, 2), tensors, "w")


def test_an_optimizer_goes_on():
    def made():
        torch.manual_seed(0)
        model = torch.nn.Linear(3, 2)
        return model, torch.optim.AdamW(model.parameters(), lr=0.1)

    def step(model, optimizer, number):
        model(torch.full((1, 3), float(number))).square().sum().backward()
        optimizer.step()
        optimizer.zero_grad()

    one, its = made()
    for number in range(3):
        step(one, its, number)
    other, theirs = made()
    for number in range(2):
        step(other, theirs, number)
    third, of_third = made()
    third.load_state_dict(other.state_dict())
    checkpoints.load_optimizer(of_third, checkpoints.optimizer_tensors(theirs))
    step(third, of_third, 2)
    assert torch.equal(one.weight, third.weight)
