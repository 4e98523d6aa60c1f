"""Initial weights and settings of a run, and what must match when it continues."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from stub_baseline import STUB
from training_runs import assert_same, change_record, stop_at, train

from robocas_ms3.baselines.training.session import ProgressCallbacks, choose_facts, load_initial_weights
from robocas_ms3.core.errors import OutputExistsError, TrainingError
from robocas_ms3.evaluation.policies import make_policy

CALIBRATION = {"calibration": {"x": [1.0, 2], "hand": True}}
SCALES = {"inputs": {"mean": [0.5] * 20}}
SIMULATION = {"observation_size": 30, "horizon": 100}


def combine(whole, facts, own):
    change_record(whole, facts=facts)
    initial = load_initial_weights(STUB, whole, None, whole)
    return choose_facts(own, initial, None if facts is SIMULATION else Path("data"))


@pytest.mark.parametrize(
    ("facts", "own", "expected"),
    [
        (CALIBRATION, {"calibration": {"x": [1.0004, 2], "hand": True}}, CALIBRATION),  # equal to a mm
        (SCALES, {"inputs": {"mean": [9.0] * 20}}, SCALES),  # the weights fit the other run's
        (
            SIMULATION,
            {"observation_size": 30, "horizon": 200},
            {"observation_size": 30, "horizon": 200},
        ),  # those of its environments
    ],
)
def test_facts_with_initial_weights(whole, facts, own, expected):
    assert combine(whole, facts, own) == expected


@pytest.mark.parametrize(
    ("facts", "own", "found"),
    [
        (CALIBRATION, {"calibration": {"x": [1.002, 2], "hand": True}}, "calibration.x.0: 1.0 -> 1.002"),
        (CALIBRATION, {"calibration": {"x": [1.0, 3], "hand": True}}, "calibration.x.1: 2 -> 3"),
        (CALIBRATION, {"calibration": {"x": [1.0], "hand": True}}, "calibration.x: [1.0, 2] -> [1.0]"),
        (CALIBRATION, {"calibration": {"x": [1.0, 2], "hand": False}}, "calibration.hand: true -> false"),
        (CALIBRATION, {}, "calibration: {"),
        (SCALES, {"inputs": {"mean": [9.0] * 30}}, "inputs.mean: ["),  # the scenes hold another number of objects
        (SIMULATION, {"observation_size": 40, "horizon": 200}, "observation_size: 30 -> 40"),
    ],
)
def test_initial_weights_with_other_inputs_are_refused(whole, facts, own, found):
    with pytest.raises(TrainingError) as caught:
        combine(whole, facts, own)
    assert caught.value.found.startswith(found)
    assert len(str(caught.value)) < 300  # the first difference, not all matrices


@pytest.mark.parametrize("changes", [{"widht": 3}, {"train": {"steps": 0}}, {"width": "wide"}], ids=str)
def test_invalid_options(stub, data, tmp_path, changes):
    with pytest.raises(TrainingError):
        train("stub", data, tmp_path / "run", changes)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda run, data: data.write_text("others"), "run.json"),
        (lambda run, data: change_record(run, baseline="rt1"), "run.json"),
        (lambda run, data: change_record(run, version=0, config={"depth": 3}), "run.json"),
        (lambda run, data: change_record(run, versions={"torch": "1.0"}), "run.json"),
        (lambda run, data: (run / "run.json").write_text("{"), ""),
        (lambda run, data: (run / "checkpoint.safetensors").write_bytes(b"x"), "checkpoint.safetensors"),
    ],
)
def test_a_run_with_other_data_or_settings_is_not_continued(whole, data, change, where):
    change(whole, data)
    with pytest.raises((TrainingError, OutputExistsError)) as error:
        train("stub", data, whole)
    assert error.value.where == whole / where
    assert (whole / "weights.safetensors").is_file()


def test_initial_weights_and_configuration_come_from_another_run(stub, data, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    train("stub", data, first, {"width": 8, "train": {"steps": 8, "learning_rate": 0.002}})
    data.write_text("more")
    record = train("stub", data, second, {"train": {"steps": 1, "learning_rate": 1e-9, "ema": 0}}, init_from=first)
    assert record.config["width"] == 8 and record.config["train"]["batch_size"] == 4  # the baseline's default
    before, after = (load_file(folder / "weights.safetensors") for folder in (first, second))
    assert all(torch.allclose(before[key], after[key], atol=1e-6) for key in before)
    assert record.init_from.startswith("first, ")
    descriptions = [make_policy(str(folder)).describe() for folder in (first, second)]
    assert descriptions[1]["init_from"] == record.init_from
    assert descriptions[0]["weights"] != descriptions[1]["weights"]
    change_record(second, facts={"inputs": 3, "image_sizes": {"base_camera": [64, 48]}})
    for start, options in ((tmp_path, {}), (first, {"width": 5}), (second, {})):  # no run; other sizes; other images
        with pytest.raises(TrainingError):
            train("stub", data, tmp_path / "other", options, init_from=start)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("step", [3, 11])
def test_a_run_with_initial_weights_continues_with_the_same_weights(whole, data, tmp_path, step):
    """At step 3 there is no checkpoint yet: the initial weights are needed again."""
    other = shutil.copytree(whole, tmp_path / "other")
    out, few = tmp_path / "next", {"train": {"steps": 12}}
    with pytest.raises(RuntimeError):
        train("stub", data, out, few, init_from=whole, progress=stop_at(step, RuntimeError("gone")))
    if step == 3:
        with pytest.raises(TrainingError) as caught:
            train("stub", data, out)
        assert caught.value.where == out and "--init-from" in caught.value.fix
    for folder in (out, whole):
        with pytest.raises(OutputExistsError, match="init_from: "):
            train("stub", data, folder, init_from=other)
    train("stub", data, out, init_from=whole)
    train("stub", data, out)
    train("stub", data, tmp_path / "unbroken", few, init_from=whole)
    assert_same(tmp_path / "unbroken", out)


def test_configuration_keys_newer_than_the_run_have_their_defaults(whole, data):
    config = json.loads((whole / "run.json").read_text())["config"]
    del config["width"]
    change_record(whole, config=config)
    train("stub", data, whole)


@pytest.mark.parametrize(
    ("recorded", "changes"),
    [
        ({"device": "cuda"}, ["from step 40: device cpu"]),
        ({"threads": 99}, ["from step 40: threads {threads}"]),
        ({"threads": 0}, []),  # not known
    ],
)
def test_hardware_changes_are_recorded(whole, data, recorded, changes):
    changes = [change.format(threads=torch.get_num_threads()) for change in changes]  # other tests change it
    change_record(whole, **recorded)
    messages = []
    train("stub", data, whole, progress=ProgressCallbacks(message=messages.append))
    assert json.loads((whole / "run.json").read_text())["hardware_changes"] == changes
    assert all(any(change in message for message in messages) for change in changes)
