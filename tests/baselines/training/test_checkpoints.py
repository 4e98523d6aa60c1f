"""Checkpoints and weights: whole or not there, of one run only, and damage is an error."""

import re
import resource

import pytest
import torch

from robocas_ms3.baselines.training import checkpoints
from robocas_ms3.core.errors import TrainingError

ABOUT = {"baseline": "x", "version": "1", "dataset": "d"}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "c.safetensors"


def test_there_and_back(path):
    checkpoints.save(path, {"a.b": torch.arange(3.0), "a.c.d": torch.tensor(2), "e": torch.zeros(1)}, ABOUT, 7)
    checkpoint = checkpoints.load(path, ABOUT)
    assert checkpoint.step == 7 and checkpoint.tensors.keys() == {"a.b", "a.c.d", "e"}
    part = checkpoint.part("a")
    assert part["b"].tolist() == [0, 1, 2] and part["c.d"].item() == 2 and len(part) == 2
    assert checkpoints.join_parts(a=part).keys() == {"a.b", "a.c.d"}
    assert [entry.name for entry in path.parent.iterdir()] == ["c.safetensors"]


def test_equal_contents_are_equal_files(path):
    """safetensors itself writes metadata in any order."""
    about = {f"key{number}": "x" * number for number in range(20)}
    tensors = {"b": torch.arange(7, dtype=torch.uint8), "a": torch.arange(3.0), "c": torch.tensor(2)}
    contents = set()
    for _ in range(5):
        checkpoints.save(path, tensors, about, 1)
        contents.add(path.read_bytes())
    assert len(contents) == 1
    back = checkpoints.load(path, about).tensors
    assert all(torch.equal(back[name], tensors[name]) for name in tensors)


@pytest.mark.parametrize("key", ABOUT)
def test_another_run_s_file_is_refused(path, key):
    checkpoints.save(path, {"a": torch.zeros(1)}, ABOUT, 1)
    with pytest.raises(TrainingError) as caught:
        checkpoints.load(path, {**ABOUT, key: "other"})
    assert (caught.value.where, caught.value.expected) == (path, "other")


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"abc"),
        lambda path: path.write_bytes(b"\xff" * 100),
        lambda path: path.write_bytes(path.read_bytes()[:2000]),
    ],
)
def test_damaged_and_missing_files(path, damage):
    checkpoints.save(path, {"a": torch.zeros(1000)}, ABOUT, 1)
    damage(path)
    with pytest.raises(TrainingError) as caught:
        checkpoints.load(path, ABOUT)
    assert caught.value.where == path


def test_without_room_the_previous_file_stays(path):
    """No file may be larger than a kilobyte: the system refuses more, as if the disk was full."""
    checkpoints.save(path, {"a": torch.zeros(1)}, ABOUT, 1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match=re.escape(str(path))):
            checkpoints.save(path, {"a": torch.ones(1000)}, ABOUT, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert checkpoints.load(path, ABOUT).tensors["a"].item() == 0
    assert [entry.name for entry in path.parent.iterdir()] == ["c.safetensors"]


@pytest.mark.parametrize(
    ("tensors", "where", "expected", "found"),
    [
        ({"weight": torch.zeros(2, 3)}, "bias", [2], "none"),
        ({"weight": torch.zeros(2, 3), "bias": torch.zeros(2), "more": torch.zeros(1)}, "more", "none", [1]),
        ({"weight": torch.zeros(2, 4), "bias": torch.zeros(2)}, "weight", [2, 3], [2, 4]),
    ],
)
def test_weights_of_another_model(path, tensors, where, expected, found):
    checkpoint = checkpoints.Checkpoint(path, 1, tensors)
    with pytest.raises(TrainingError) as caught:
        checkpoint.load_model(torch.nn.Linear(3, 2))
    assert (caught.value.where, caught.value.expected, caught.value.found) == (f"{path}, {where}", expected, found)


def test_an_optimizer_continues(path):
    def make():
        torch.manual_seed(0)
        model = torch.nn.Linear(3, 2)
        return model, torch.optim.AdamW(model.parameters(), lr=0.1)

    def step(model, optimizer, number):
        model(torch.full((1, 3), float(number))).square().sum().backward()
        optimizer.step()
        optimizer.zero_grad()

    whole, optimizer = make()
    for number in range(3):
        step(whole, optimizer, number)
    first, optimizer = make()
    for number in range(2):
        step(first, optimizer, number)
    tensors = checkpoints.join_parts(model=first.state_dict(), optimizer=checkpoints.optimizer_tensors(optimizer))
    checkpoints.save(path, tensors, ABOUT, 2)
    second, optimizer = make()
    checkpoint = checkpoints.load(path, ABOUT)
    checkpoint.load_model(second, "model")
    checkpoint.load_optimizer(optimizer)
    step(second, optimizer, 2)
    assert torch.equal(whole.weight, second.weight)
