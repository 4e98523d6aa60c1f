"""What ``robocas convert`` and ``robocas validate`` print."""

import json
import shutil

import pytest
from managing import convert_made_up as convert
from synthetic import RayCaster, render_by, write_trajectory

from robocas_ms3.cli.main import run
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion import convert as conversion
from robocas_ms3.datasets.formats import open_source


@pytest.fixture
def stub_images(monkeypatch):
    monkeypatch.setattr(conversion, "convert", render_by(RayCaster, conversion.convert))


def test_a_conversion_and_its_repetition(trajectory, stub_images, tmp_path, capsys):
    command = ["convert", str(trajectory), "--out", str(tmp_path / "out"), "--no-embeddings", "--no-video"]
    assert run(command) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{tmp_path / 'out'}: 2 episodes, 14 steps, ")
    assert "episodes written: 2/2" in printed.err
    assert run(command) == 0
    assert capsys.readouterr().out.endswith(": 0 episodes, 2 already there\n")


def test_the_folder_of_generate_is_a_source(trajectory, stub_images, tmp_path, capsys):
    demos = tmp_path / "demos"
    demos.mkdir()
    for suffix in (".h5", ".json"):
        shutil.copy(trajectory.with_suffix(suffix), demos / f"trajectory{suffix}")
    out = str(tmp_path / "out")
    assert run(["convert", str(demos), "--out", out, "--no-embeddings", "--no-video"]) == 0
    assert validate(tmp_path / "out").episodes == 2
    assert len(open_source(demos, include_failed=True).numbers) == 3
    capsys.readouterr()
    assert run(["stats", str(demos), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 3


@pytest.mark.parametrize("rate", ["2.5", "3"])
def test_invalid_rate_of_a_lerobot_dataset_is_wrong_usage(trajectory, tmp_path, capsys, rate):
    pytest.importorskip("av", reason="needs the extra 'lerobot'")
    out = tmp_path / "out"
    assert run(["convert", str(trajectory), "--to", "lerobot", "--rate", rate, "--out", str(out)]) == 2
    assert not out.exists()


def tried(path, *rates):
    """A trajectory file with recordings checked open loop at these rates."""
    write_trajectory(path, seeds=tuple(range(len(rates))))
    content = json.loads(path.with_suffix(".json").read_text())
    for episode, rate in zip(content["episodes"], rates, strict=True):
        episode["robocas"]["check_rate"] = rate
    path.with_suffix(".json").write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("rates", "rate_hz", "said"),
    [
        ((5, 5), 5, ""),
        ((5, 20), 10, "the recorded actions were checked open loop at 5 and 20 Hz, but the dataset has 10 Hz; "),
        ((None, 0), 10, ""),  # not tried at any rate: the base drives, or nobody wanted it
        (([5], "5"), 10, ""),  # not ours
    ],
)
def test_warning_for_another_rate_than_that_of_the_open_loop_check(tmp_path, caplog, rates, rate_hz, said):
    trajectory = tried(tmp_path / "F.h5", *rates)
    convert(trajectory, tmp_path / "out", rate_hz=rate_hz)
    warnings = [record.getMessage() for record in caplog.records if record.name.startswith("robocas_ms3")]
    assert len(warnings) == bool(said)
    assert not said or warnings[0].startswith(said)


def test_failed_recordings_cause_no_rate_warning(tmp_path, caplog):
    path = tried(tmp_path / "F.h5", 5, 10)
    content = json.loads(path.with_suffix(".json").read_text())
    content["episodes"][0]["success"] = False
    path.with_suffix(".json").write_text(json.dumps(content))
    convert(path, tmp_path / "out", rate_hz=10)
    assert caplog.records == []


@pytest.mark.parametrize(
    ("flags", "code", "said"),
    [
        ("--append --overwrite", 2, "--overwrite: can't be combined with --append"),
        ("--jobs 0", 2, "expected 1 or more, found 0"),
        ("--cameras base_camera base_camera", 2, "expected each name once, found base_camera base_camera"),
    ],
)
def test_invalid_options(made, trajectory, capsys, flags, code, said):
    assert run(["convert", str(trajectory), "--out", str(made), *flags.split()]) == code
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ((), "; run the same command to continue"),
        (("--overwrite",), "; run the same command without --overwrite to continue"),
    ],
)
def test_interrupted_conversion_prints_how_to_continue(monkeypatch, tmp_path, capsys, flags, said):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(conversion, "convert", interrupted)
    (tmp_path / "F.h5").touch()
    command = ["convert", str(tmp_path / "F.h5"), "--out", str(tmp_path / "out"), *flags]
    assert run(command) == 130
    assert capsys.readouterr().err == f"interrupted{said}\n"


def test_warning_for_missing_episodes_of_another_trajectory(tmp_path, caplog):
    """--append of b was killed; converting a again can't make b's episodes."""
    a, b = (write_trajectory(tmp_path / f"{n}.h5", seeds=seeds) for n, seeds in (("a", (1, 2)), ("b", (3, 4, 5))))
    out = tmp_path / "out"
    convert(a, out)
    convert(b, out, append=True)
    for number in (2, 4):
        shutil.rmtree(out / f"episode_000000{number}")
    assert caplog.records == []
    convert(a, out)
    said = [record.getMessage() for record in caplog.records]
    assert said == [f"{out}: episodes 2, 4 of b.h5 are missing; add them with robocas convert --append"]
    hint = "found no folder (convert b.h5 again, or with --append)"
    assert [str(v) for v in validate(out).violations] == [
        f"conversion.json, episodes.{number}: expected the episodes on disk, {hint}" for number in (2, 4)
    ]
    convert(b, out, append=True)
    assert len(caplog.records) == 1
    assert validate(out).violations == []
