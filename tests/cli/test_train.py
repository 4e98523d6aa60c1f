"""`robocas train`: configuration from options, defaults, one-line errors."""

import json
import re
from pathlib import Path

import pytest
from stub_baseline import STUB

from robocas_ms3.baselines.registry import BASELINES
from robocas_ms3.cli.main import run
from robocas_ms3.cli.train import COMMANDS, PluginBaseline, Training, command, config_layers


@pytest.fixture
def stub(monkeypatch):
    monkeypatch.setitem(BASELINES.builtin, "stub", lambda: STUB)
    monkeypatch.setitem(COMMANDS, "stub", command("stub", PluginBaseline))


def test_options_override_the_file_and_later_options_earlier_ones(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("chunk: 4\ntrain: {steps: 10, seed: 1, ema: 0.5}\nviews: {gripper_camera: null}\n")
    values = ("chunk=5", "train.seed=2", "train.learning_rate=3e-4", "chunk=6")
    layers = config_layers(Training(config=file, set=values, steps=20, batch_size=8, seed=3))
    assert layers == [
        (str(file), {"chunk": 4, "train": {"steps": 10, "seed": 1, "ema": 0.5}, "views": {"gripper_camera": None}}),
        ("--set", {"chunk": 6, "train": {"steps": 20, "seed": 3, "learning_rate": 3e-4, "batch_size": 8}}),
    ]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "c.yaml: no such file"),
        ("a: [", "c.yaml: unreadable file"),
        ("- a", "invalid configuration.*a mapping.*list"),
        ("widht: 3", "c.yaml: unknown key 'widht'.*Did you mean width"),
    ],
)
def test_invalid_configuration_files(stub, tmp_path, capsys, content, expected):
    file, data = tmp_path / "c.yaml", tmp_path / "data.h5"
    data.write_text("demonstrations")
    if content is not None:
        file.write_text(content)
    words = ["train", "stub", "--data", str(data), "--out", str(tmp_path / "run"), "--config", str(file)]
    assert run(words) == (2 if content is None else 1)
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(f"^error: .*{expected}", line)
    assert not (tmp_path / "run").exists()


def test_unknown_key_of_set_exits_with_2(stub, tmp_path, capsys):
    data, file = tmp_path / "data.h5", tmp_path / "c.yaml"
    data.write_text("demonstrations")
    file.write_text("width: 3\n")
    words = ["train", "stub", "--data", str(data), "--out", str(tmp_path / "run"), "--config", str(file)]
    assert run([*words, "--set", "widht=4"]) == 2
    assert "error: --set: unknown key 'widht'" in capsys.readouterr().err


def test_training_from_the_command_line(stub, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("data.h5").write_text("demonstrations")
    options = ["--steps", "8", "--batch-size", "2", "--seed", "5", "--set", "width=3", "--device", "cpu"]
    assert run(["train", "stub", "--data", "data.h5", *options]) == 0
    made = Path("runs") / f"stub-{tmp_path.name}"  # named by the folder of the trajectory
    record = json.loads((made / "run.json").read_text())
    assert record["config"]["width"] == 3
    assert [record["config"]["train"][key] for key in ("steps", "batch_size", "seed")] == [8, 2, 5]
    output = capsys.readouterr()
    assert f"robocas eval TASK --policy {made} --protocol PROTOCOL" in output.out
    assert "steps trained: 8/8" in output.err
