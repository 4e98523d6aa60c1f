"""What a run begins or goes on with: options, another run's weights, and what has to be the same."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from made_up_baseline import MadeUp
from made_up_runs import assert_same, say, stop_at
from safetensors.torch import load_file

from robocas_ms3.baselines.begin import facts_of, find_start, merged
from robocas_ms3.baselines.session import Said, train_run
from robocas_ms3.core.errors import OutputExistsError, TrainingError
from robocas_ms3.evaluation.policies import make_policy


@pytest.mark.parametrize(
    ("own", "fits"),
    [
        ({"x": [1.0004, 2], "hand": True}, True),
        ({"x": [1.002, 2], "hand": True}, False),
        ({"x": [1.0, 3], "hand": True}, False),
        ({"x": [1.0], "hand": True}, False),
        ({"x": [1.0, 2], "hand": False}, False),
        (None, False),
    ],
)
def test_a_start_has_seen_by_the_same_cameras(whole, made_up, own, fits):
    """To a mm: calibrations are not the same to the bit."""
    say(whole, facts={"calibration": {"x": [1.0, 2], "hand": True}})
    begin = find_start(MadeUp(), whole, None, whole)
    if fits:
        assert facts_of({"calibration": own}, begin, Path("data")) == begin.record.facts
    else:
        with pytest.raises(TrainingError, match="calibration.*: --start is of a run with other calibration") as caught:
            facts_of({"calibration": own}, begin, Path("data"))
        assert len(str(caught.value)) < 300  # of what differs first, not of all matrices


def test_a_start_has_scales_of_as_many_numbers(whole, made_up):
    """Where other things stand in the scenes, a simulator tells more or less."""
    say(whole, facts={"inputs": {"mean": [0.5] * 20}})
    begin = find_start(MadeUp(), whole, None, whole)
    assert facts_of({"inputs": {"mean": [9.0] * 20}}, begin, Path("data")) == begin.record.facts
    with pytest.raises(TrainingError, match="inputs.mean: --start is of a run with other inputs.*20 values.*30 values"):
        facts_of({"inputs": {"mean": [9.0] * 30}}, begin, Path("data"))
    say(whole, facts={"inputs": {"mean": [0.5, 2.0]}})
    begin = find_start(MadeUp(), whole, None, whole)
    with pytest.raises(TrainingError, match=r"expected \[0.5, 2.0\], found \[9.0\]"):  # there is room
        facts_of({"inputs": {"mean": [9.0]}}, begin, Path("data"))


def test_who_tries_knows_of_its_own_trials(whole, made_up):
    say(whole, facts={"observed": 30, "horizon": 100})
    begin = find_start(MadeUp(), whole, None, whole)
    assert facts_of({"observed": 30, "horizon": 200}, begin, None) == {"observed": 30, "horizon": 200}
    with pytest.raises(TrainingError, match="other observed.*expected 30, found 40"):
        facts_of({"observed": 40, "horizon": 200}, begin, None)


def test_options_leave_the_other_defaults(made_up, data, tmp_path):
    record = train_run("made-up", data, tmp_path / "run", {"train": {"steps": 3}}, device="cpu")
    assert record.config["train"]["steps"] == 3
    assert record.config["train"]["batch_size"] == 4  # the baseline's, not TrainSettings'


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"widht": 3}, "width"), ({"train": {"steps": 0}}, "train.steps"), ({"width": "wide"}, "width")],
)
def test_wrong_options(made_up, data, tmp_path, changes, message):
    with pytest.raises(TrainingError, match=message):
        train_run("made-up", data, tmp_path / "run", changes, device="cpu")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda run, data: data.write_text("others"), "run.json"),
        (lambda run, data: say(run, baseline="rt1"), "run.json"),
        (lambda run, data: say(run, version=0, config={"depth": 3}), "run.json"),
        (lambda run, data: say(run, versions={"torch": "1.0"}), "run.json"),
        (lambda run, data: (run / "run.json").write_text("{"), ""),
        (lambda run, data: (run / "checkpoint.safetensors").write_bytes(b"x"), "checkpoint.safetensors"),
    ],
)
def test_a_run_of_something_else_is_not_continued(whole, data, change, where):
    change(whole, data)
    with pytest.raises((TrainingError, OutputExistsError)) as error:
        train_run("made-up", data, whole, device="cpu")
    assert error.value.where == whole / where
    assert (whole / "weights.safetensors").is_file()


def test_a_run_may_begin_with_anothers_weights(whole, data, tmp_path):
    data.write_text("more")
    changes = {"train": {"steps": 1, "learning_rate": 1e-9, "ema": 0}}
    record = train_run("made-up", data, tmp_path / "next", changes, start=whole, device="cpu")
    first, second = (load_file(folder / "weights.safetensors") for folder in (whole, tmp_path / "next"))
    assert all(torch.allclose(first[key], second[key], atol=1e-6) for key in first)
    assert record.start.startswith("whole, ")
    with pytest.raises(TrainingError, match="no run of robocas train"):
        train_run("made-up", data, tmp_path / "other", start=tmp_path, device="cpu")
    with pytest.raises(TrainingError, match="not the weights of this model"):
        train_run("made-up", data, tmp_path / "other", {"width": 5}, start=whole, device="cpu")
    assert not (tmp_path / "other").exists()


def test_a_run_goes_on_from_what_it_began_with(whole, data, tmp_path):
    other = shutil.copytree(whole, tmp_path / "other")
    out, few = tmp_path / "next", {"train": {"steps": 12}}
    with pytest.raises(RuntimeError):
        train_run("made-up", data, out, few, start=whole, device="cpu", said=stop_at(11, RuntimeError("gone")))
    with pytest.raises(OutputExistsError, match='start: "whole, .*" -> "other, '):
        train_run("made-up", data, out, start=other, device="cpu")
    with pytest.raises(OutputExistsError, match='start: "" -> "other, '):
        train_run("made-up", data, whole, start=other, device="cpu")
    train_run("made-up", data, out, start=whole, device="cpu")
    train_run("made-up", data, out, device="cpu")
    train_run("made-up", data, tmp_path / "unbroken", few, start=whole, device="cpu")
    assert_same(tmp_path / "unbroken", out)


def test_a_run_that_had_no_checkpoint_begins_with_the_same_weights(whole, data, tmp_path):
    out, few = tmp_path / "next", {"train": {"steps": 12}}
    with pytest.raises(RuntimeError):
        train_run("made-up", data, out, few, start=whole, device="cpu", said=stop_at(3, RuntimeError("gone")))
    with pytest.raises(TrainingError, match="begins with another's weights.*expected whole,.*--start again"):
        train_run("made-up", data, out, device="cpu")
    train_run("made-up", data, out, start=whole, device="cpu")
    train_run("made-up", data, tmp_path / "unbroken", few, start=whole, device="cpu")
    assert_same(tmp_path / "unbroken", out)


def test_other_options_are_refused_with_their_values(whole, data):
    options = {"width": 5, "train": {"learning_rate": 9e-4}}
    with pytest.raises(OutputExistsError) as error:
        train_run("made-up", data, whole, options, device="cpu")
    assert sorted(error.value.found.split("; ")) == [
        "config.train.learning_rate: 0.001 -> 0.0009",
        "config.width: 4 -> 5",
    ]


def test_an_option_that_is_newer_than_the_run_has_its_default(whole, data):
    config = json.loads((whole / "run.json").read_text())["config"]
    del config["width"]
    say(whole, config=config)
    train_run("made-up", data, whole, device="cpu")


def test_to_go_on_elsewhere_is_said_and_kept(whole, data):
    say(whole, device="cuda")
    notes = []
    train_run("made-up", data, whole, device="cpu", said=Said(note=notes.append))
    (said,) = json.loads((whole / "run.json").read_text())["resumed"]
    assert said == "from step 40 by device cpu"
    assert any(said in note for note in notes)


def test_other_threads_are_said_where_their_number_is_known(whole, data):
    assert json.loads((whole / "run.json").read_text())["threads"] == torch.get_num_threads()
    for threads, said in ((99, [f"from step 40 by threads {torch.get_num_threads()}"]), (0, [])):
        say(whole, threads=threads, resumed=[])
        assert train_run("made-up", data, whole, device="cpu").resumed == said


def test_a_run_begins_as_the_one_it_starts_from_but_for_its_options(made_up, data, tmp_path):
    changes = {"width": 8, "train": {"steps": 8, "learning_rate": 0.002}}
    train_run("made-up", data, tmp_path / "first", changes, device="cpu")
    record = train_run(
        "made-up", data, tmp_path / "more", {"train": {"steps": 4}}, device="cpu", start=tmp_path / "first"
    )
    assert (record.config["width"], record.config["train"]["learning_rate"]) == (8, 0.002)
    assert record.config["train"]["steps"] == 4
    assert record.start.startswith("first, ")
    about = make_policy(str(tmp_path / "more")).describe()
    assert about["start"] == record.start and len(about["weights"]) == 64
    assert about["weights"] != make_policy(str(tmp_path / "first")).describe()["weights"]


def test_a_run_on_other_pictures_is_not_begun_with(whole, made_up, data, tmp_path, monkeypatch):
    say(whole, facts={"inputs": 3, "pictures": {"base_camera": [64, 48]}})
    with pytest.raises(TrainingError, match="--start is of a run with other pictures"):
        train_run("made-up", data, tmp_path / "more", device="cpu", start=whole)
    assert not (tmp_path / "more").exists()


def test_nested_values():
    assert merged({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 4}, "e": 5}) == {"a": {"b": 4, "c": 2}, "d": 3, "e": 5}
