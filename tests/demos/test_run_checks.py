"""A wrong argument is one line, before anything is written or a bar is shown."""

import json
from dataclasses import asdict, replace

import h5py
import pytest
from synthetic import write_trajectory

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError, OutputExistsError, RobocasError
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.demos import generate as module
from robocas_ms3.demos.checks import SIM_FREQ, WEIGHTS, check_same_run
from robocas_ms3.demos.convert_actions import CONVERTIBLE
from robocas_ms3.demos.episode import EpisodeResult, EpisodeSettings
from robocas_ms3.demos.generate import _recorded, generate
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.replay import replay
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.tasks.base import RoboCASEnv

SETTINGS = EpisodeSettings("pick", "pick_table_scattered", "builtin")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seed", "-5"], "seed: this number is out of range (expected 0 to 4294967295, found -5)"),
        (["--seed", "4294967296"], "found 4294967296)"),
        (["--control-freq", "7"], "(expected one of 1, 2, 4, 5, 10, 20, 25, 50, 100, found 7)"),
        (["--control-freq", "0"], "control_freq: this number is out of range (expected 1 to 100, found 0)"),
        (["--max-attempts", "0"], "max_attempts: this number is out of range (expected at least 1, found 0)"),
        (["-n", "0"], "episodes: this number is out of range (expected at least 1, found 0)"),
        (["-n", "-3"], "found -3)"),
        (["--jobs", "0"], "jobs: this number is out of range (expected at least 1, found 0)"),
        (["--episode-seconds", "0"], "episode_seconds: this number is out of range (expected at least 1, found 0.0)"),
        (["--memory-gb", "nan"], "memory_gb: this number is out of range (expected at least 0.1, found nan)"),
        (["--pack", "nothing"], "nothing: no such asset pack"),
        (["--config", "pick_table_scatered"], "Did you mean pick_table_scattered"),
        (
            ["--config", "search_table_stacked"],
            "RoboCASPick-v1 can't run the configuration search_table_stacked (expected task: pick, found task: search)",
        ),
    ],
)
def test_a_wrong_argument_of_generate_leaves_nothing(tmp_path, capsys, words, message):
    assert run(["generate", "pick", "--out", str(tmp_path / "a" / "out"), *words]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1  # no bar
    assert message in captured.err
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []


def test_the_rate_of_physics_is_the_environments():
    env = RoboCASEnv.__new__(RoboCASEnv)
    env.num_envs, env.task_config = 1, load_task_config("pick_table_scattered")
    assert env._default_sim_config.sim_freq == SIM_FREQ


def begun(out, *, ledger=""):
    """What a run leaves that was killed before it was through with its first seed."""
    (out / "episodes").mkdir(parents=True)
    (out / "run.json").write_text(json.dumps({"settings": {"task": "another"}, "first_seed": 7}))
    (out / "failures.jsonl").write_text(ledger)
    (out / "episodes" / "seed_000000007.json").write_text("{")
    (out / "episodes" / "seed_000000007.h5").write_bytes(b"")
    return out


@pytest.fixture
def hopeless(monkeypatch):
    """Every seed is given up."""

    def give_up(settings, seeds, folder, jobs, *, fork, limits, players):
        for seed in seeds:
            yield EpisodeResult(seed, success=False, failures=[Failure(seed, 0, "reach", "far", 0.0)])

    monkeypatch.setattr(module, "generate_seeds", give_up)


@pytest.mark.parametrize("resume", [False, True])
def test_a_run_that_never_got_anywhere_is_in_nobodys_way(tmp_path, hopeless, resume):
    out, started = begun(tmp_path / "out"), []
    with pytest.raises(RobocasError, match="far too many seeds fail"):
        generate(SETTINGS, out, episodes=1, resume=resume, on_start=started.append)
    assert started == [0]  # so many of its episodes were there
    made = json.loads((out / "run.json").read_text())
    assert (made["settings"]["task"], made["first_seed"]) == ("pick", 0)


def test_what_a_run_has_found_out_stays(tmp_path, hopeless):
    given_up = json.dumps({"seed": 7, "attempt": -1, "stage": "episode", "reason": "gave_up", "seconds": 0.0})
    out = begun(tmp_path / "out", ledger=given_up + "\n")
    with pytest.raises(OutputExistsError):
        generate(SETTINGS, out, episodes=1)
    with pytest.raises(RobocasError, match="settings"):
        generate(SETTINGS, out, episodes=1, resume=True)
    (out / "failures.jsonl").write_text("")
    (out / "notes.txt").write_text("mine")
    with pytest.raises(OutputExistsError):
        generate(SETTINGS, out, episodes=1)
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("flags", [{}, {"resume": True}, {"overwrite": True}])
@pytest.mark.parametrize("notes", ['{"protocol": "smoke", "protocol_hash": "ab"}', '"settings"', ""])
def test_results_of_an_evaluation_are_not_touched(tmp_path, hopeless, notes, flags):
    """They have a run.json as well, before their first episode nothing else."""
    (tmp_path / "run.json").write_text(notes)
    with pytest.raises(OutputExistsError, match=r"run.json: refusing to write over what `robocas gen") as said:
        generate(SETTINGS, tmp_path, episodes=1, **flags)
    assert "(expected settings, found " in str(said.value)
    assert (tmp_path / "run.json").read_text() == notes


def test_to_go_on_and_to_begin_again_exclude_each_other(tmp_path, hopeless):
    out = begun(tmp_path / "out", ledger="kept")
    with pytest.raises(RobocasError, match=r"generate: these exclude each other .*found --resume --overwrite"):
        generate(SETTINGS, out, episodes=1, resume=True, overwrite=True)
    assert (out / "failures.jsonl").read_text() == "kept"


def test_two_runs_do_not_share_a_folder(tmp_path, hopeless):
    out = begun(tmp_path / "out")
    with locked_folder(out), pytest.raises(RobocasError, match="another process is writing here"):
        generate(SETTINGS, out, episodes=1)
    assert (out / "run.json").is_file()


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
        (["-c", "pd_foo"], f"(expected one of {', '.join(CONVERTIBLE)}, found pd_foo)"),
        (["-o", "foo"], "obs_mode: no such observation mode"),
        (["--count", "0"], "count: this number is out of range (expected at least 1, found 0)"),
        (["--save", "x.txt"], "x.txt: a trajectory is an HDF5 file"),
    ],
)
def test_a_wrong_argument_of_replay_is_told_at_once(recording, capsys, words, message):
    before = sorted(recording.parent.iterdir())
    assert run(["replay", str(recording.parent), *words]) == 1  # the folder serves as the file
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert sorted(recording.parent.iterdir()) == before


def test_a_replay_never_replaces_what_it_replays(recording):
    with pytest.raises(RobocasError, match="the recording itself"):
        replay(recording, save=recording, overwrite=True)
    other = recording.with_name("other.h5")
    other.write_bytes(b"")
    with pytest.raises(OutputExistsError, match=r"the output exists already\. Pass --overwrite to replace it\.$"):
        replay(recording, save=other)
    notes = recording.with_name("run.json")  # as `robocas generate` leaves one
    notes.write_text("{}")
    with pytest.raises(OutputExistsError, match=r"run\.json: the output exists already"):
        replay(recording, save=notes.with_suffix(".h5"))
    assert recording.is_file()
    assert notes.read_text() == "{}"


def test_converting_a_folder_names_the_file_in_it(recording, tmp_path, capsys):
    assert run(["convert", str(recording.parent), "--out", str(tmp_path / "out"), "--no-embeddings"]) == 1
    assert f"Did you mean {recording}?" in capsys.readouterr().err


def test_a_setting_that_is_newer_than_the_output_had_its_default(tmp_path):
    settings = asdict(EpisodeSettings("pick", "pick_table_scattered", "builtin"))
    older = {key: value for key, value in settings.items() if key != "planner"}
    (tmp_path / "run.json").write_text(json.dumps({"settings": older}))
    check_same_run(tmp_path / "run.json", {"settings": settings})
    with pytest.raises(RobocasError, match="settings"):
        check_same_run(tmp_path / "run.json", {"settings": {**settings, "planner": "straight"}})


def test_other_versions_do_not_go_on_with_an_output(tmp_path):
    made = {"settings": asdict(SETTINGS), "versions": {"sapien": "3.0.3", "numpy": "1.26.4"}}
    (tmp_path / "run.json").write_text(json.dumps({**made, "versions": {"sapien": "2.2.2", "numpy": "1.26.4"}}))
    with pytest.raises(RobocasError, match=r"other versions than .*\(expected sapien 2\.2\.2, found sapien 3\.0\.3\)"):
        check_same_run(tmp_path / "run.json", made)
    (tmp_path / "run.json").write_text(json.dumps({"settings": made["settings"]}))  # before they were noted
    check_same_run(tmp_path / "run.json", made)


@pytest.mark.parametrize(
    "change",
    [{"episode_seed": None}, {"robocas": {"seconds": {}}}, {"robocas": {"attempts": 1, "seconds": {"ik": "x"}}}],
)
def test_a_trajectory_of_something_else_is_not_gone_on_with(tmp_path, change):
    path = write_trajectory(tmp_path / "trajectory.h5", seeds=(3,))
    content = json.loads(path.with_suffix(".json").read_text())
    about = {"attempts": 1, "seconds": {"ik": 0.5}}
    episode = {**content["episodes"][0], "robocas": about, **change}
    path.with_suffix(".json").write_text(json.dumps({**content, "episodes": [episode]}))
    with pytest.raises(DatasetError, match=r"trajectory.json: this is not of `robocas generate`.*--overwrite"):
        _recorded(path, {})


def test_a_policy_that_acts_first_needs_something_that_has_it_act(tmp_path):
    with pytest.raises(RobocasError, match="go together"):
        generate(replace(SETTINGS, after_policy="random"), tmp_path / "out", episodes=1)
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_older_than_the_steps_of_a_policy_goes_on(tmp_path):
    path, now = tmp_path / "run.json", asdict(SETTINGS)
    older = {name: value for name, value in now.items() if not name.startswith("after_")}
    path.write_text(json.dumps({"settings": older}))
    check_same_run(path, {"settings": now})
    with pytest.raises(RobocasError, match="settings"):
        check_same_run(path, {"settings": asdict(replace(SETTINGS, after_steps=(5, 61)))})


def test_other_weights_do_not_go_on_with_an_output(tmp_path):
    """A folder of a run may hold others by now; outputs that are older do not say which."""
    made = {"settings": asdict(SETTINGS), WEIGHTS: "abc"}
    for before, fits in ((made, True), ({"settings": made["settings"]}, True), ({**made, WEIGHTS: "def"}, False)):
        (tmp_path / "run.json").write_text(json.dumps(before))
        if fits:
            check_same_run(tmp_path / "run.json", made)
            continue
        with pytest.raises(RobocasError, match="after_policy_weights.*expected def, found abc"):
            check_same_run(tmp_path / "run.json", made)
