"""Runs: begun, broken off and gone on with to the bit, refused where they are of something else."""

import errno
import json
import os
import re
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import made_up_baseline
import pytest
import torch
from made_up_runs import assert_same, lines, say, stop_at
from safetensors.torch import load_file

from robocas_ms3.baselines import checkpoints, devices
from robocas_ms3.baselines.policy import RunPolicy
from robocas_ms3.baselines.session import Said, train_run
from robocas_ms3.baselines.train import Trainer
from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError, ExtensionError, OutputExistsError, RobocasError, TrainingError
from robocas_ms3.evaluation.policies import make_policy


def test_a_run_leaves_what_it_says(whole):
    assert {path.name for path in whole.iterdir()} == {
        *("run.json", "metrics.csv", "tensorboard", "checkpoint.safetensors", "weights.safetensors")
    }
    run = json.loads((whole / "run.json").read_text())
    assert (run["baseline"], run["data"]["episodes"], run["data"]["samples"]) == ("made-up", 3, 30)
    assert run["config"]["train"]["steps"] == 40 and run["facts"] == {"inputs": 3}
    assert {"torch", "numpy", "robocas-ms3"} <= run["versions"].keys()
    rows = lines(whole)
    assert [row["step"] for row in rows if row["split"] == "train"] == [str(step) for step in range(4, 41, 4)]
    assert [row["step"] for row in rows if row["split"] == "val"] == ["20", "40"]
    assert float(rows[-1]["loss"]) < float(rows[0]["loss"])
    assert float(rows[0]["double"]) == pytest.approx(2 * float(rows[0]["loss"]), rel=1e-4)
    assert list((whole / "tensorboard").iterdir())


def test_what_not_every_sample_tells_is_a_mean_of_those_that_do(whole):
    x = made_up_baseline.MadeUpSamples(-1, -1).x[:, 0]
    (last,) = (row for row in lines(whole) if (row["step"], row["split"]) == ("40", "val"))
    assert float(last["high"]) == pytest.approx(x[x > 0].mean().item(), rel=1e-5)


def test_everybody_may_read_a_run(whole):
    assert {path.stat().st_mode & 0o777 for path in whole.glob("*.safetensors")} == {0o644}


@pytest.mark.parametrize("step", [1, 17, 20, 39])
def test_ctrl_c_loses_nothing(whole, data, tmp_path, step):
    out = tmp_path / "again"
    with pytest.raises(KeyboardInterrupt):
        train_run("made-up", data, out, device="cpu", said=stop_at(step, KeyboardInterrupt()))
    train_run("made-up", data, out, device="cpu")
    assert_same(whole, out)


@pytest.mark.parametrize("step", [5, 17, 31])
def test_a_crash_loses_what_came_after_the_last_checkpoint(whole, data, tmp_path, step):
    out = tmp_path / "again"
    with pytest.raises(RuntimeError):
        train_run("made-up", data, out, device="cpu", said=stop_at(step, RuntimeError("gone")))
    done = []
    train_run("made-up", data, out, device="cpu", said=Said(step=lambda at, of: done.append(at)))
    assert done[0] == step // 10 * 10
    assert_same(whole, out)


@pytest.mark.parametrize("name", ["weights.safetensors", "checkpoint.safetensors"])
@pytest.mark.parametrize("at", [20, 40])
def test_a_checkpoint_that_finds_no_room_is_written_later(whole, data, tmp_path, monkeypatch, name, at):
    """The last one too: a run that is done acts by its last step."""
    save = checkpoints.save

    def full(path, tensors, about):
        if path.name == name and about["step"] == str(at):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        save(path, tensors, about)

    out = tmp_path / "again"
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "save", full)
        with pytest.raises(OSError, match=f"No space.*{name}"):
            train_run("made-up", data, out, device="cpu")
    train_run("made-up", data, out, device="cpu")
    assert_same(whole, out)


@pytest.mark.parametrize("change", [Path.unlink, lambda path: path.write_bytes(b"\xff" * 100)])
def test_what_a_run_acts_with_is_mended_from_its_checkpoint(whole, data, change):
    before = (whole / "weights.safetensors").read_bytes()
    change(whole / "weights.safetensors")
    with pytest.raises(TrainingError):
        RunPolicy(whole)
    train_run("made-up", data, whole, device="cpu")
    assert (whole / "weights.safetensors").read_bytes() == before


@pytest.mark.parametrize("room", [0, 4, 8, 16])
def test_a_full_disk_is_one_line_and_loses_nothing(whole, data, small_disk, capsys, room):
    """A real one, with room for so many kB: it is full at the record, the log, the curves or a checkpoint."""
    out = small_disk / "run"
    words = ["train", "made-up", "--data", str(data), "--out", str(out), "--device", "cpu"]
    filler = small_disk / "filler"
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    os.truncate(filler, filler.stat().st_size // 4096 * 4096 - 1024 * room)
    assert run(words) == 1
    said = capsys.readouterr().err
    assert re.search(r"^error: .*/small/run.*: No space left on device.*Make room", said.splitlines()[-1])
    assert "Traceback" not in said
    filler.unlink()
    assert run(words) == 0
    assert_same(whole, out)


@pytest.mark.parametrize("at", [20, 40])
def test_a_validation_can_be_broken_off_and_is_made_up_for(whole, data, tmp_path, monkeypatch, at):
    checked = Trainer._checked

    def broken(self, samples):
        if self.step == at:
            raise KeyboardInterrupt
        return checked(self, samples)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_checked", broken)
        with pytest.raises(KeyboardInterrupt):
            train_run("made-up", data, tmp_path / "again", device="cpu")
    assert (str(at), "val") not in {(row["step"], row["split"]) for row in lines(tmp_path / "again")}
    train_run("made-up", data, tmp_path / "again", device="cpu")
    assert_same(whole, tmp_path / "again")


def test_what_is_done_is_done(whole, data):
    before = (whole / "weights.safetensors").read_bytes()
    train_run("made-up", data, whole, device="cpu")
    assert (whole / "weights.safetensors").read_bytes() == before


def test_seeds_differ(whole, data, tmp_path):
    train_run("made-up", data, tmp_path / "other", {"train": {"seed": 1}}, device="cpu")
    first, second = (load_file(folder / "weights.safetensors") for folder in (whole, tmp_path / "other"))
    assert not torch.equal(first["net.0.weight"], second["net.0.weight"])


def test_no_such_baseline(data, tmp_path):
    with pytest.raises(TrainingError, match="no such baseline.*small"):
        train_run("smal", data, tmp_path / "run")


def test_no_data(made_up, tmp_path):
    with pytest.raises(TrainingError, match="no dataset here"):
        train_run("made-up", tmp_path / "none.h5", tmp_path / "run", device="cpu")
    assert not (tmp_path / "run").exists()


def test_what_is_none_of_ours_is_not_replaced(made_up, data, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(OutputExistsError):
        train_run("made-up", data, tmp_path / "mine", device="cpu", overwrite=True)
    assert (tmp_path / "mine" / "thesis.tex").exists()


def test_overwrite_begins_anew(whole, data):
    train_run("made-up", data, whole, {"train": {"steps": 4}}, device="cpu", overwrite=True)
    assert len(lines(whole)) == 2


def test_a_loss_that_is_no_number_ends_the_run_and_keeps_the_last_checkpoint(made_up, data, tmp_path):
    done, changes = [], {"broken_at": 7, "train": {"save_every": 1}}
    said = Said(step=lambda at, _: done.append(at))
    with pytest.raises(TrainingError, match="the loss is no number any more.*learning_rate"):
        train_run("made-up", data, tmp_path / "run", changes, device="cpu", said=said)
    for name in ("checkpoint", "weights"):
        tensors, about = checkpoints.load(tmp_path / "run" / f"{name}.safetensors", {})
        assert all(tensor.isfinite().all() for tensor in tensors.values())
        assert int(about["step"]) == done[-1] > 0


@pytest.mark.parametrize("clip_norm", [0.0, 1.0])
def test_a_gradient_that_is_no_number_is_not_followed(made_up, data, tmp_path, clip_norm):
    changes = {"steep_at": 7, "train": {"save_every": 1, "clip_norm": clip_norm}}
    done = []
    with pytest.raises(TrainingError, match=r"step \d+: the gradient is no number any more.*learning_rate"):
        train_run(
            "made-up", data, tmp_path / "run", changes, device="cpu", said=Said(step=lambda at, _: done.append(at))
        )
    saved = load_file(tmp_path / "run" / "checkpoint.safetensors")
    assert all(tensor.isfinite().all() for tensor in saved.values())
    assert saved["optimizer.0.step"] == done[-1] > 0


def test_what_is_not_waited_for_is_looked_at_before_it_is_saved(made_up, data, tmp_path, monkeypatch):
    """As on a GPU, but that the log doesn't end the run either."""
    monkeypatch.setattr(Trainer, "_check_numbers", lambda self, step, **values: None)
    changes = {"steep_at": 7, "train": {"save_every": 1, "log_every": 100, "check_every": 100}}
    train_run("made-up", data, tmp_path / "run", changes, device="cpu")
    for name in ("checkpoint", "weights"):
        assert all(tensor.isfinite().all() for tensor in load_file(tmp_path / "run" / f"{name}.safetensors").values())


def test_a_folder_that_goes_is_missed(made_up, data, tmp_path):
    out = tmp_path / "run"

    def remove(done, of):
        if done == 5:
            shutil.rmtree(out)

    with pytest.raises(RobocasError) as caught:
        train_run("made-up", data, out, device="cpu", said=Said(step=remove))
    assert caught.value.where == out


def test_a_folder_that_is_removed_during_a_write_is_an_error_of_the_training(made_up, data, tmp_path, monkeypatch):
    out, before = tmp_path / "run", checkpoints.save

    def save(path, tensors, about):
        shutil.rmtree(out, ignore_errors=True)
        before(path, tensors, about)

    monkeypatch.setattr(checkpoints, "save", save)
    with pytest.raises(RobocasError) as caught:
        train_run("made-up", data, out, device="cpu")
    assert caught.value.where == out


def test_a_baseline_can_not_end_the_process(made_up, data, tmp_path, monkeypatch):
    monkeypatch.setattr(made_up, "model", lambda self, config, facts: sys.exit(0))
    with pytest.raises(ExtensionError) as caught:
        train_run("made-up", data, tmp_path / "run", device="cpu")
    assert caught.value.where == "baseline made-up"


def test_a_baseline_that_changes_the_working_directory(made_up, data, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    model = made_up.model
    monkeypatch.setattr(made_up, "model", lambda *args: os.chdir(tmp_path / "elsewhere") or model(*args))
    assert run(["train", "made-up", "--data", data.name, "--out", "run", "--steps", "4", "--device", "cpu"]) == 0
    assert (tmp_path / "run" / "run.json").is_file()
    assert not list((tmp_path / "elsewhere").iterdir())


def test_without_validation(made_up, data, tmp_path):
    data.write_text("few")
    notes = []
    train_run("made-up", data, tmp_path / "run", device="cpu", said=Said(note=notes.append))
    assert any("too few" in note for note in notes)
    assert {row["split"] for row in lines(tmp_path / "run")} == {"train"}


def test_a_damaged_validation_is_not_none(made_up, data, tmp_path):
    data.write_text("damaged")
    with pytest.raises(DatasetError, match="this split is damaged"):
        train_run("made-up", data, tmp_path / "run", device="cpu")


def test_processes_share_a_batch_evenly(made_up, data, tmp_path, monkeypatch):
    monkeypatch.setattr(devices, "make_accelerator", lambda *_: SimpleNamespace(num_processes=3))
    with pytest.raises(TrainingError, match="train.batch_size: processes share a batch evenly.*4 for 3 processes"):
        train_run("made-up", data, tmp_path / "run", device="cpu")


def test_a_kill_before_there_was_a_run_is_gone_on_from(made_up, data, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".run.123.tmp.json").write_text("{")
    train_run("made-up", data, tmp_path / "run", {"train": {"steps": 4}}, device="cpu")
    assert not list((tmp_path / "run").glob(".*"))


def test_what_a_kill_left_half_written_goes(whole, data):
    (whole / ".checkpoint.123.tmp.safetensors").write_bytes(b"half")
    train_run("made-up", data, whole, device="cpu")
    assert not list(whole.glob(".*"))


def test_no_run_to_go_on_with(made_up, data, tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / ".draft.tmp.txt").write_text("mine")
    (tmp_path / "notes" / "notes.txt").write_text("mine")
    with pytest.raises(OutputExistsError):
        train_run("made-up", data, tmp_path / "notes", device="cpu")
    assert len(list((tmp_path / "notes").iterdir())) == 2


def test_a_worker_says_what_is_wrong_in_a_line(made_up, data, tmp_path):
    with pytest.raises(DatasetError) as caught:
        train_run("made-up", data, tmp_path / "run", {"damaged_at": 7, "train": {"workers": 1}}, device="cpu")
    assert str(caught.value) == "sample 7: damaged. Mend it."


def test_what_another_trainer_left_is_no_run_to_go_on_with(made_up, data, tmp_path):
    log = tmp_path / "run" / "metrics.csv"
    log.parent.mkdir()
    log.write_text("epoch,loss\n3,0.5\n")
    with pytest.raises(OutputExistsError):
        train_run("made-up", data, log.parent, device="cpu")
    assert log.read_text() == "epoch,loss\n3,0.5\n"


def test_a_run_is_a_policy(whole):
    policy = make_policy(str(whole))
    assert isinstance(policy, RunPolicy)
    about = policy.describe()
    assert (about["baseline"], about["steps"], about["data"]["samples"]) == ("made-up", 40, 30)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run: (run / "weights.safetensors").unlink(), "no such file"),
        (lambda run: say(run, version=2), "another version"),
        (lambda run: say(run, config={"widht": 1}), "width"),
        (
            lambda run: say(run, facts={"inputs": 5}),
            r"net.0.weight: not the.*expected \[4, 5\], found \[4, 3\]",
        ),
        (lambda run: say(run, baseline="smal"), "no such baseline"),
        (lambda run: (run / "run.json").write_text('{"protocol_hash": 1}'), "no run of robocas train"),
    ],
)
def test_a_run_that_is_no_policy(whole, change, message):
    change(whole)
    with pytest.raises(TrainingError, match=message):
        make_policy(str(whole))


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """Runs of two processes, see `made_up_baseline`, and their data."""
    out = tmp_path_factory.mktemp("shared")
    (out / "data.h5").write_text("demonstrations")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    world = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}
    words = [sys.executable, made_up_baseline.__file__, str(out / "data.h5"), str(out)]
    env = {**os.environ, **world, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    processes = [
        subprocess.Popen(words, env={**env, "RANK": rank, "LOCAL_RANK": rank}, stderr=subprocess.PIPE, text=True)
        for rank in "01"
    ]
    try:
        said = [process.communicate(timeout=300)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], said
    return out


@pytest.mark.slow
def test_each_process_goes_on_with_its_own_random_state(shared):
    assert_same(shared / "whole", shared / "again")
    saved = load_file(shared / "again" / "checkpoint.safetensors")
    assert not torch.equal(saved["random.cpu.0"], saved["random.cpu.1"])


@pytest.mark.slow
def test_a_run_goes_on_in_as_many_processes(made_up, shared):
    with pytest.raises(TrainingError, match="as many processes as it began.*expected 2, found 1.*num_processes 2"):
        train_run("made-up", shared / "data.h5", shared / "whole", device="cpu")
