"""Checkpoint files: atomic writes, metadata of the run, damaged files."""

import pytest
import torch

from robocas_ms3.baselines.training import checkpoints
from robocas_ms3.core.errors import TrainingError

ABOUT = {"baseline": "x", "version": "1", "dataset": "d"}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "c.safetensors"


def test_save_and_load(path):
    checkpoints.save_tensors(path, {"a.b": torch.arange(3.0), "a.c.d": torch.tensor(2), "e": torch.zeros(1)}, ABOUT, 7)
    checkpoint = checkpoints.load_checkpoint(path, ABOUT)
    assert checkpoint.step == 7 and checkpoint.tensors.keys() == {"a.b", "a.c.d", "e"}
    part = checkpoint.state_dict("a")
    assert part["b"].tolist() == [0, 1, 2] and part["c.d"].item() == 2 and len(part) == 2
    assert checkpoints.join_state_dicts(a=part).keys() == {"a.b", "a.c.d"}
    assert [entry.name for entry in path.parent.iterdir()] == ["c.safetensors"]


def test_equal_contents_are_equal_files(path):
    """safetensors itself writes metadata in random order."""
    about = {f"key{number}": "x" * number for number in range(20)}
    tensors = {"b": torch.arange(7, dtype=torch.uint8), "a": torch.arange(3.0), "c": torch.tensor(2)}
    contents = set()
    for _ in range(5):
        checkpoints.save_tensors(path, tensors, about, 1)
        contents.add(path.read_bytes())
    assert len(contents) == 1
    back = checkpoints.load_checkpoint(path, about).tensors
    assert all(torch.equal(back[name], tensors[name]) for name in tensors)


@pytest.mark.parametrize("key", ABOUT)
def test_file_of_another_run_is_refused(path, key):
    checkpoints.save_tensors(path, {"a": torch.zeros(1)}, ABOUT, 1)
    with pytest.raises(TrainingError) as caught:
        checkpoints.load_checkpoint(path, {**ABOUT, key: "other"})
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
    checkpoints.save_tensors(path, {"a": torch.zeros(1000)}, ABOUT, 1)
    damage(path)
    with pytest.raises(TrainingError) as caught:
        checkpoints.load_checkpoint(path, ABOUT)
    assert caught.value.where == path


@pytest.mark.parametrize(
    ("tensors", "where", "expected", "found"),
    [
        ({"weight": torch.zeros(2, 3)}, "bias", "shape [2]", "no such tensor"),
        (
            {"weight": torch.zeros(2, 3), "bias": torch.zeros(2), "more": torch.zeros(1)},
            "more",
            "no such tensor",
            "shape [1]",
        ),
        ({"weight": torch.zeros(2, 4), "bias": torch.zeros(2)}, "weight", "shape [2, 3]", "shape [2, 4]"),
    ],
)
def test_weights_of_another_model(path, tensors, where, expected, found):
    checkpoint = checkpoints.Checkpoint(path, 1, tensors)
    with pytest.raises(TrainingError) as caught:
        checkpoint.load_model(torch.nn.Linear(3, 2))
    assert (caught.value.where, caught.value.expected, caught.value.found) == (f"{path}, {where}", expected, found)
