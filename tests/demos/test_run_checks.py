"""Invalid arguments are one-line errors, before files are written or progress is shown."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import h5py
import pytest
from synthetic import write_trajectory

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError, OutputExistsError, RobocasError
from robocas_ms3.demos import generation as module
from robocas_ms3.demos.failures import EpisodeResult, FailedAttempt
from robocas_ms3.demos.generation import WEIGHTS
from robocas_ms3.demos.settings import EpisodeSettings, GenerateSettings, ReplaySettings
from robocas_ms3.demos.trajectory_replay import CONVERTIBLE, replay

SETTINGS = EpisodeSettings("pick")


def generate(settings, out, *, overwrite=False, **how):
    return module.generate(GenerateSettings(settings, out, episodes=1, overwrite=overwrite), **how)


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "demo" / "trajectory.h5"
    path.parent.mkdir()
    h5py.File(path, "w").close()
    info = {"env_id": "robocas_ms3:RoboCASPick-v1", "env_kwargs": {"control_mode": "pd_joint_pos"}}
    path.with_suffix(".json").write_text(json.dumps({"env_info": info, "episodes": []}))
    return path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("generate --seed -5", "--seed: number out of range (expected 0 to 4294967295, found -5)"),
        (
            "generate --control-freq 7",
            "--control-freq: invalid control rate (expected one of 1, 2, 4, 5, 10, 20, 25, 50, 100 Hz",
        ),
        ("generate --action-noise 1 -1", "--action-noise: "),
        ("generate --candidates 4", "--candidates: this option needs --record-candidates"),
        ("generate --record-candidates --candidate-decisions", "--candidate-decisions: "),
        ("generate --record-candidates --no-fork", "--record-candidates: "),
        ("generate -n 0", "--episodes: "),
        ("generate --jobs -1", "--jobs: "),
        ("generate --memory-gb nan", "--memory-gb: "),
        ("generate --pack nothing", "nothing: no such asset pack"),
        ("generate --config pick_table_scatered", "Did you mean pick_table_scattered"),
        ("generate --config search_table_stacked", "(expected task: pick, found task: search)"),
        (
            "replay -c pd_foo",
            f"--control-mode: unknown control mode (expected one of {', '.join(CONVERTIBLE)}, found pd_foo)",
        ),
        ("replay -o foo", "--obs-mode: "),
        ("replay --count 0", "--count: "),
        ("replay --save x.txt", "x.txt: "),
    ],
)
def test_invalid_argument_is_a_one_line_error_without_files(tmp_path, recording, capsys, words, message):
    command, *words = words.split()
    of_command = {"generate": ["pick", "--out", str(tmp_path / "a" / "out")], "replay": [str(recording.parent)]}
    before = sorted(tmp_path.rglob("*"))
    assert run([command, *of_command[command], *words]) == (1 if message.startswith("x.txt") else 2)
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1  # no bar
    assert message in captured.err
    assert captured.out == ""
    assert sorted(tmp_path.rglob("*")) == before


def test_resolved_settings_do_not_change_again():
    settings = GenerateSettings(EpisodeSettings("pick"), set=("objects.count=6",), check_noise=(1.0, 2.0)).resolve()
    assert settings == settings.resolve()
    assert isinstance(settings.episode.config, dict)
    assert settings.episode.config["objects"]["count"] == 6
    assert (settings.episode.check_noise_mm, settings.episode.check_noise_deg) == (1.0, 2.0)
    assert settings.out == Path("demos/pick_table_scattered-builtin")


@pytest.mark.parametrize(
    ("options", "check_rate"),
    [
        ({}, 5),
        ({"action_noise": (3.0, 1.0)}, 0),
        ({"action_noise": (0.0, 1.0)}, 0),
        ({"action_noise": (3.0, 1.0), "check_rate": 5}, 5),
    ],
)
def test_open_loop_check_is_off_by_default_with_action_noise(options, check_rate):
    """The intended actions of such demonstrations do not succeed open loop."""
    assert EpisodeSettings("pick", **options).check_rate == check_rate


def killed_run(out, **record):
    """Write the files of a run that was killed after a skipped seed."""
    skipped = {"seed": 0, "attempt": -1, "stage": "episode", "reason": "skipped", "seconds": 0.0}
    out.mkdir(exist_ok=True)
    (out / "run.json").write_text(json.dumps({"settings": asdict(SETTINGS), "first_seed": 0, **record}))
    (out / "failures.jsonl").write_text(json.dumps(skipped) + "\n")
    return out


@pytest.fixture
def skipping_generator(monkeypatch):
    """Replace the generator by one that skips all seeds."""

    def skip_all(settings, seeds, folder, make_roll_in):
        for seed in seeds:
            yield EpisodeResult(seed, success=False, failures=[FailedAttempt(seed, 0, "reach", "far", 0.0)])

    monkeypatch.setattr(module, "generate_seeds", skip_all)


def test_run_without_a_finished_seed_leaves_no_files(tmp_path, monkeypatch):
    def interrupted(settings, seeds, folder, make_roll_in):
        (folder / "seed_000000000.json").write_text("{")
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(module, "generate_seeds", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(SETTINGS, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_replay_does_not_overwrite_its_recording(recording):
    with pytest.raises(RobocasError, match="the recording itself"):
        replay(ReplaySettings(recording, save=recording, overwrite=True))
    other = recording.with_name("other.h5")
    other.write_bytes(b"")
    with pytest.raises(OutputExistsError):
        replay(ReplaySettings(recording, save=other))
    notes = recording.with_name("run.json")  # as `robocas generate` leaves one
    notes.write_text("{}")
    with pytest.raises(OutputExistsError) as error:
        replay(ReplaySettings(recording, save=notes.with_suffix(".h5")))
    assert error.value.where == notes
    assert recording.is_file()
    assert notes.read_text() == "{}"


DEFAULTS = ("planner", "check_failures", "after_policy", "after_steps", "action_noise")


@pytest.mark.parametrize(
    ("settings", "record", "change"),
    [
        (SETTINGS, {}, None),
        (replace(SETTINGS, check_failures=2), {}, "settings.check_failures"),
        (replace(SETTINGS, after_steps=(5, 61)), {}, "settings.after_steps.1"),
        (SETTINGS, {"versions": {"sapien": "2.2.2"}}, "versions.sapien"),
        (SETTINGS, {"first_seed": 7}, "first_seed"),
        (SETTINGS, {WEIGHTS: "abc"}, None),
        (replace(SETTINGS, after_policy="random"), {WEIGHTS: "abc"}, WEIGHTS),
    ],
)
def test_run_is_resumed_with_the_same_settings_only(tmp_path, skipping_generator, settings, record, change):
    """Settings and versions that an older version did not record have their defaults."""
    known = asdict(settings) if change == WEIGHTS else asdict(SETTINGS)
    older = {key: value for key, value in known.items() if key not in DEFAULTS or change == WEIGHTS}
    out, there = killed_run(tmp_path / "out", settings=older, **record), []
    acting = {"make_roll_in": lambda: None, "weights": "def"} if settings.after_policy else {}
    with pytest.raises(RobocasError) as error:
        generate(settings, out, on_start=there.append, **acting)
    if change is None:
        assert (error.value.where, there) == (out, [0])  # far too many seeds fail
        return
    assert change in str(error.value.found)
    assert (error.value.where, there) == (out / "run.json", [])


@pytest.mark.parametrize(
    "change",
    [{"episode_seed": None}, {"robocas": {"seconds": {}}}, {"robocas": {"attempts": 1, "seconds": {"ik": "x"}}}],
)
def test_trajectory_of_another_tool_is_not_resumed(tmp_path, skipping_generator, change):
    path = write_trajectory(killed_run(tmp_path / "out") / "trajectory.h5", seeds=(3,))
    content = json.loads(path.with_suffix(".json").read_text())
    about = {"attempts": 1, "seconds": {"ik": 0.5}}
    episode = {**content["episodes"][0], "robocas": about, **change}
    path.with_suffix(".json").write_text(json.dumps({**content, "episodes": [episode]}))
    with pytest.raises(DatasetError) as error:
        generate(SETTINGS, tmp_path / "out")
    assert error.value.where == path.with_suffix(".json")
