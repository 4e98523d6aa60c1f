"""Training runs: bit-identical continuation after interruptions, and refused folders."""

import json
import os
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import devices as devices_check
import pytest
import stub_baseline
import torch
from safetensors.torch import load_file
from training_runs import assert_finite, assert_same, change_record, read_log, stop_at, train

from robocas_ms3.baselines.policy import RunPolicy
from robocas_ms3.baselines.training import checkpoints, run_folder
from robocas_ms3.baselines.training.learner import Learner
from robocas_ms3.baselines.training.session import ProgressCallbacks, merge_configs
from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError, ExtensionError, OutputExistsError, RobocasError, TrainingError
from robocas_ms3.evaluation.policies import make_policy


def test_files_of_a_run_and_its_policy(whole):
    assert {path.name for path in whole.iterdir()} == {
        *("run.json", "metrics.csv", "tensorboard", "checkpoint.safetensors", "weights.safetensors")
    }
    record = json.loads((whole / "run.json").read_text())
    assert (record["baseline"], record["data"]["episodes"], record["data"]["samples"]) == ("stub", 3, 30)
    assert record["config"]["train"]["steps"] == 40 and record["facts"] == {"inputs": 3}
    assert {"torch", "numpy", "robocas-ms3"} <= record["versions"].keys()
    assert record["threads"] == torch.get_num_threads()
    assert {path.stat().st_mode & 0o777 for path in whole.glob("*.safetensors")} == {0o644}  # for everybody to read
    description = make_policy(str(whole)).describe()
    assert (description["baseline"], description["steps"], description["data"]["samples"]) == ("stub", 40, 30)
    assert 0 < description["training_seconds"] < 600
    assert description["hardware"] == record["hardware"] and record["hardware"].startswith("1 x ")
    assert description["parameters"] == sum(
        tensor.numel() for tensor in load_file(whole / "weights.safetensors").values()
    )


def test_metrics_of_a_run(whole):
    train, val = read_log(whole, "train"), read_log(whole, "val")
    assert [row["step"] for row in train] == [str(step) for step in range(4, 41, 4)]
    assert [row["step"] for row in val] == ["20", "40"]
    assert float(val[-1]["loss"]) < float(train[0]["loss"])
    assert float(train[0]["double"]) == pytest.approx(2 * float(train[0]["loss"]), rel=1e-4)
    x = stub_baseline.StubSamples(-1, -1).x[:, 0]
    assert float(val[-1]["high"]) == pytest.approx(x[x > 0].mean().item(), rel=1e-5)  # of the samples that have it
    assert list((whole / "tensorboard").iterdir())


@pytest.mark.parametrize(
    ("step", "error", "continued_at"),
    [*((step, KeyboardInterrupt, step) for step in (17, 20)), (5, RuntimeError, 0), (31, RuntimeError, 30)],
)
def test_a_stopped_run_continues_bit_identically(whole, data, tmp_path, step, error, continued_at):
    """Ctrl-C loses no step, a crash loses the steps after the last checkpoint."""
    out, steps = tmp_path / "again", []
    with pytest.raises(error):
        train("stub", data, out, progress=stop_at(step, error("stopped")))
    if continued_at:
        (warning,) = make_policy(str(out)).protocol_warnings({})
        assert f"training stopped at step {continued_at} of 40" in warning
    train("stub", data, out, progress=ProgressCallbacks(on_step=lambda done, total: steps.append(done)))
    assert steps[0] == continued_at
    assert make_policy(str(out)).protocol_warnings({}) == []
    assert_same(whole, out)


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(b"\xff" * 100)])
def test_weights_are_repaired_from_the_checkpoint(whole, data, damage):
    before = (whole / "weights.safetensors").read_bytes()
    damage(whole / "weights.safetensors")
    with pytest.raises(TrainingError):
        RunPolicy(whole)
    train("stub", data, whole)
    assert (whole / "weights.safetensors").read_bytes() == before


class NormModel(stub_baseline.StubModel):
    """The stub network with a BatchNorm before it."""

    def __init__(self, config, facts):
        super().__init__(config, facts)
        self.norm = torch.nn.BatchNorm1d(facts["inputs"])

    def forward(self, batch):
        return super().forward({**batch, "x": self.norm(batch["x"])})


def test_statistics_of_norms_are_averaged_as_the_weights(stub, data, tmp_path):
    stub(model=NormModel)
    means = {}
    for steps in (1, 2):
        train("stub", data, tmp_path / str(steps), {"train": {"steps": steps, "ema": 0.25}})
        state = load_file(tmp_path / str(steps) / "checkpoint.safetensors")
        weights = load_file(tmp_path / str(steps) / "weights.safetensors")
        assert weights["norm.num_batches_tracked"] == steps
        means[steps] = state["model.norm.running_mean"], weights["norm.running_mean"]
    assert torch.equal(*means[1])  # the average starts with the first weights
    expected = 0.25 * means[1][1] + 0.75 * means[2][0]
    assert torch.allclose(means[2][1], expected) and not torch.equal(*means[2])


def test_half_precision_weights_are_half_the_size(whole, data, tmp_path):
    train("stub", data, tmp_path / "half", {"train": {"weights_precision": "fp16"}})
    weights, full = (load_file(run / "weights.safetensors") for run in (tmp_path / "half", whole))
    assert {value.dtype for value in weights.values()} == {torch.float16}
    for name, value in full.items():
        assert torch.equal(weights[name], value.half())
    assert RunPolicy(tmp_path / "half").describe()["steps"] == 40


@pytest.mark.parametrize("room", [0, 4, 8, 16])
def test_a_full_disk_is_an_error_and_the_run_continues(whole, data, small_disk, capsys, room):
    """On a real small disk with ``room`` kB: writing the record, log, curves or checkpoint fails."""
    out = small_disk / "run"
    words = ["train", "stub", "--data", str(data), "--out", str(out), "--device", "cpu"]
    filler = small_disk / "filler"
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    os.truncate(filler, filler.stat().st_size // 4096 * 4096 - 1024 * room)
    assert run(words) == 1
    output = capsys.readouterr().err
    assert output.splitlines()[-1].startswith("error: ") and "No space left on device" in output
    assert "Traceback" not in output
    filler.unlink()
    assert run(words) == 0
    assert_same(whole, out)


@pytest.mark.parametrize("step", [20, 40])
def test_an_interrupted_validation_is_repeated(whole, data, tmp_path, monkeypatch, step):
    evaluate = Learner.evaluate

    def interrupted(self, batches):
        if self.step == step:
            raise KeyboardInterrupt
        return evaluate(self, batches)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "evaluate", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train("stub", data, tmp_path / "again")
    assert str(step) not in {row["step"] for row in read_log(tmp_path / "again", "val")}
    train("stub", data, tmp_path / "again")
    assert_same(whole, tmp_path / "again")


def test_a_finished_run_is_unchanged_and_seeds_differ(whole, data, tmp_path):
    before = (whole / "weights.safetensors").read_bytes()
    train("stub", data, whole)
    assert (whole / "weights.safetensors").read_bytes() == before
    train("stub", data, tmp_path / "other", {"train": {"seed": 1}})
    first, second = (load_file(folder / "weights.safetensors") for folder in (whole, tmp_path / "other"))
    assert not torch.equal(first["net.0.weight"], second["net.0.weight"])


def test_unknown_baseline_and_missing_data(stub, data, tmp_path):
    with pytest.raises(TrainingError, match="small"):
        train("smal", data, tmp_path / "run")
    with pytest.raises(TrainingError) as caught:
        train("stub", tmp_path / "none.h5", tmp_path / "run")
    assert caught.value.where == tmp_path / "none.h5"
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_with_other_files_is_refused(stub, data, tmp_path, overwrite):
    """A folder with notes, or with the log of another trainer."""
    out = tmp_path / "mine"
    out.mkdir()
    (out / ".draft.tmp.txt").write_text("mine")
    (out / "metrics.csv").write_text("epoch,loss\n3,0.5\n")
    with pytest.raises(OutputExistsError):
        train("stub", data, out, overwrite=overwrite)
    assert (out / "metrics.csv").read_text() == "epoch,loss\n3,0.5\n"
    assert len(list(out.iterdir())) == 2


def test_overwrite_starts_again(whole, data):
    train("stub", data, whole, {"train": {"steps": 4}}, overwrite=True)
    assert len(read_log(whole)) == 2


@pytest.mark.parametrize(
    "changes", [{"broken_at": 7}, {"steep_at": 7}, {"steep_at": 7, "train": {"clip_norm": 0.0}}], ids=str
)
def test_a_nan_ends_the_run_and_the_last_checkpoint_stays(stub, data, tmp_path, changes):
    """A NaN in the loss, or in the gradient alone."""
    out, done = tmp_path / "run", []
    changes = merge_configs(changes, {"train": {"save_every": 1}})
    progress = ProgressCallbacks(on_step=lambda step, _: done.append(step))
    with pytest.raises(TrainingError):
        train("stub", data, out, changes, progress=progress)
    assert_finite(out)
    for name in ("checkpoint", "weights"):
        assert checkpoints.load_checkpoint(out / f"{name}.safetensors", {}).step == done[-1] > 0
    assert load_file(out / "checkpoint.safetensors")["optimizer.0.step"] == done[-1]


def test_an_unchecked_nan_is_not_saved(stub, data, tmp_path, monkeypatch):
    """As on a GPU, where values are checked late, and without log lines, which would end the run."""
    monkeypatch.setattr(Learner, "check_finite", lambda self, step, **values: None)
    changes = {"steep_at": 7, "train": {"save_every": 1, "log_every": 100, "validate_every": 100}}
    train("stub", data, tmp_path / "run", changes)
    assert_finite(tmp_path / "run")


def test_a_removed_folder_is_an_error(stub, data, tmp_path, monkeypatch):
    """The folder is removed between two steps, or during a write."""
    out, save = tmp_path / "run", checkpoints.save_tensors

    def remove(done, total):
        if done == 5:
            shutil.rmtree(out)

    def remove_and_save(path, *what):
        shutil.rmtree(out, ignore_errors=True)
        save(path, *what)

    with pytest.raises(RobocasError) as caught:
        train("stub", data, out, progress=ProgressCallbacks(on_step=remove))
    assert caught.value.where == out
    monkeypatch.setattr(checkpoints, "save_tensors", remove_and_save)
    with pytest.raises(RobocasError) as caught:
        train("stub", data, out)
    assert caught.value.where == out


def test_a_baseline_cannot_end_the_process(stub, data, tmp_path):
    stub(model=lambda config, facts: sys.exit(0))
    with pytest.raises(ExtensionError) as caught:
        train("stub", data, tmp_path / "run")
    assert caught.value.where == "baseline stub"


def test_a_baseline_that_changes_the_working_directory(stub, data, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    make = stub_baseline.StubModel
    stub(model=lambda *args: os.chdir(tmp_path / "elsewhere") or make(*args))
    assert run(["train", "stub", "--data", data.name, "--out", "run", "--steps", "4", "--device", "cpu"]) == 0
    assert (tmp_path / "run" / "run.json").is_file()
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_validation_split_may_be_empty_but_not_damaged(stub, data, tmp_path):
    data.write_text("few")
    train("stub", data, tmp_path / "run")
    assert {row["split"] for row in read_log(tmp_path / "run")} == {"train"}
    data.write_text("damaged")
    with pytest.raises(DatasetError):
        train("stub", data, tmp_path / "other")


def test_batch_size_must_be_a_multiple_of_the_processes(stub, data, tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "make_accelerator", lambda *_: SimpleNamespace(num_processes=3))
    with pytest.raises(TrainingError) as caught:
        train("stub", data, tmp_path / "run")
    assert caught.value.where == "train.batch_size"


def test_worker_processes_report_errors_of_the_samples(stub, data, tmp_path):
    with pytest.raises(DatasetError) as caught:
        train("stub", data, tmp_path / "run", {"damaged_at": 7, "train": {"workers": 1}})
    assert caught.value.where == "sample 7"


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda run: (run / "weights.safetensors").unlink(), "weights.safetensors"),
        (lambda run: change_record(run, version=2), ""),
        (lambda run: change_record(run, config={"widht": 1}), "width"),
        (lambda run: change_record(run, facts={"inputs": 5}), "net.0.weight"),
        (lambda run: change_record(run, baseline="smal"), "run.json"),
        (lambda run: (run / "run.json").write_text('{"protocol_hash": 1}'), "run.json"),
    ],
)
def test_invalid_runs_are_not_policies(whole, change, where):
    change(whole)
    with pytest.raises(TrainingError) as caught:
        make_policy(str(whole))
    assert str(whole) in str(caught.value.where) and where in str(caught.value)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """Return a folder with runs of two processes (`stub_baseline`) and their data."""
    out = tmp_path_factory.mktemp("shared")
    (out / "data.h5").write_text("demonstrations")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    world = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}
    words = [sys.executable, stub_baseline.__file__, str(out / "data.h5"), str(out)]
    env = {**os.environ, **world, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[3])}
    processes = [
        subprocess.Popen(words, env={**env, "RANK": rank, "LOCAL_RANK": rank}, stderr=subprocess.PIPE, text=True)
        for rank in "01"
    ]
    try:
        errors = [process.communicate(timeout=300)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], errors
    return out


@pytest.mark.slow
def test_each_process_continues_with_its_own_random_state(shared):
    assert_same(shared / "whole", shared / "again")
    saved = load_file(shared / "again" / "checkpoint.safetensors")
    assert not torch.equal(saved["random.cpu.0"], saved["random.cpu.1"])


@pytest.mark.slow
def test_a_run_continues_with_the_same_number_of_processes(stub, shared):
    with pytest.raises(TrainingError, match="num_processes 2"):
        train("stub", shared / "data.h5", shared / "whole")


@pytest.mark.parametrize("name", devices_check.CHANGES)
def test_a_real_network_in_bf16_continues_bit_identically_and_acts(folder, tmp_path, name):
    """With all random augmentations and dropout; tests/gpu runs the same check on a GPU."""
    devices_check.check(folder, tmp_path, name, "bf16", "cpu")
    config = json.loads((tmp_path / "run" / "run.json").read_text())["config"]
    train(name, folder, tmp_path / "whole", config)
    assert_same(tmp_path / "whole", tmp_path / "run")
