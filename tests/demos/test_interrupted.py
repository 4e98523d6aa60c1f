"""Interrupted runs and worker crashes do not change the result of a run; recordings are stand-ins."""

import json
import shutil
from dataclasses import asdict

import h5py
import pytest

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.demos import generation as module
from robocas_ms3.demos.failures import FAILURES_FILE, EpisodeResult, FailedAttempt
from robocas_ms3.demos.generation import seed_file_stem
from robocas_ms3.demos.recordings.trajectory_json import read_json
from robocas_ms3.demos.settings import EpisodeSettings, GenerateSettings

SETTINGS = EpisodeSettings("pick")
SKIPPED = 2  # a seed without an episode
FAILED = {1: ["reach: far"], 2: ["reach: far", "lift: slipped"], 4: ["grasp: missed", "reach: far"]}


def generate(out, episodes, **how):
    return module.generate(GenerateSettings(SETTINGS, out, episodes=episodes), **how)


def failures_of(seed):
    return [FailedAttempt(seed, i, *text.split(": "), 0.0) for i, text in enumerate(FAILED.get(seed, []))]


def lines_of(seed):
    """Return the lines of ``failures.jsonl`` for a seed."""
    return [*failures_of(seed), *([FailedAttempt(seed, -1, "episode", "skipped", 0.0)] if seed == SKIPPED else [])]


def record(folder, seed):
    """Write the file of an episode that a worker has finished."""
    path = folder / f"{seed_file_stem(seed)}.h5"
    with h5py.File(path, "w") as file:
        file.create_group("traj_0").attrs["seed"] = seed
    seconds = {"reset": 1.0, "planning": 2.0, "simulation": 3.0}
    episode = {"episode_id": 0, "episode_seed": seed, "elapsed_steps": 10 + seed}
    failed = FAILED.get(seed, [])
    episode["robocas"] = {"attempts": 1 + len(failed), "failed_attempts": failed, "seconds": seconds}
    path.with_suffix(".json").write_text(
        json.dumps({"env_info": {"env_id": "X-v1", "env_kwargs": {}}, "episodes": [episode]})
    )


@pytest.fixture(autouse=True)
def made(monkeypatch):
    """Record the seeds that are generated, in order."""
    seeds_made = []

    def make(settings, seeds, folder, make_roll_in):
        for seed in seeds:
            seeds_made.append(seed)
            if seed != SKIPPED:
                record(folder, seed)
            failures = failures_of(seed)
            yield EpisodeResult(seed, seed != SKIPPED, 10 + seed, 1 + len(failures), failures=failures)

    monkeypatch.setattr(module, "generate_seeds", make)
    return seeds_made


def seeds_of(out):
    """Return the seeds of the merged file; check that JSON and HDF5 agree."""
    episodes = read_json(out / "trajectory.h5")["episodes"]
    with h5py.File(out / "trajectory.h5") as file:
        assert sorted(file) == sorted(f"traj_{episode['episode_id']}" for episode in episodes)
        assert [file[f"traj_{e['episode_id']}"].attrs["seed"] for e in episodes] == [
            e["episode_seed"] for e in episodes
        ]
    return [episode["episode_seed"] for episode in episodes]


def write_killed_run(out, shards, lines=()):
    """Write the files of a killed run in which workers had finished some seeds out of order."""
    run = {"settings": asdict(SETTINGS), "first_seed": 0}
    (out / "episodes").mkdir(parents=True)
    (out / "run.json").write_text(json.dumps(run))
    JsonLinesFile(out / "failures.jsonl", FailedAttempt).append(lines)
    for seed in shards:
        record(out / "episodes", seed)


@pytest.mark.parametrize(
    ("shards", "skipped", "missing"),
    [((0, 1), (), [2, 3]), ((0, 1, 5), (), [2, 3]), ((0, 4, 6), (2,), [1, 3]), ((1, 3, 4), (), [0, 2])],
)
def test_seeds_finished_out_of_order_are_merged_in_order(tmp_path, made, shards, skipped, missing):
    out = tmp_path / "out"
    write_killed_run(out, shards, [line for seed in skipped for line in lines_of(seed)])
    summary = generate(out, episodes=3)
    assert made == missing
    assert seeds_of(out) == [0, 1, 3]
    assert (summary.episodes, summary.seeds, summary.skipped) == (3, 4, [SKIPPED])
    assert not (out / "episodes").exists()


@pytest.mark.parametrize(
    ("shards", "lines"),
    [
        ((0, 1, 3), ()),  # killed before its lines were written
        ((0, 1, 3, 4), [*lines_of(1), *lines_of(2)]),  # workers had finished more
        ((0, 1), lines_of(1) + lines_of(2)[:1]),  # some of a seed's lines
        ((0, 1), lines_of(1) + lines_of(2)[1:]),  # damaged since: a line is lost
        ((0,), [*lines_of(1), *lines_of(2), *lines_of(4)]),  # of a file that did not reach the disk
        ((0, 1, 4), [*lines_of(1), *lines_of(1), *lines_of(4), *lines_of(2)]),
        ((0, 1, 3, 4, 5), [*lines_of(1), *lines_of(2), *lines_of(4), *lines_of(5)]),
    ],
)
def test_failures_of_a_resumed_run_are_those_of_an_uninterrupted_run(tmp_path, shards, lines):
    """Each attempt has one line, in the order of the seeds."""
    started = []
    write_killed_run(tmp_path / "out", shards, lines)
    found = generate(tmp_path / "out", episodes=4, on_start=started.append)
    whole = generate(tmp_path / "whole", episodes=4)
    assert (tmp_path / "out" / FAILURES_FILE).read_text() == (tmp_path / "whole" / FAILURES_FILE).read_text()
    assert found.failures == whole.failures == {"reach: far": 3, "lift: slipped": 1, "grasp: missed": 1}
    assert started == [len(shards)]
    generate(tmp_path / "out", episodes=4)
    assert (tmp_path / "out" / FAILURES_FILE).read_text() == (tmp_path / "whole" / FAILURES_FILE).read_text()


@pytest.mark.parametrize("suffix", [".h5", ".json"])
@pytest.mark.parametrize("left", [0.5, 0.99, 0])
def test_truncated_episodes_are_recorded_again(tmp_path, made, suffix, left):
    out = tmp_path / "out"
    write_killed_run(out, (0, 1), lines_of(1))
    path = (out / "episodes" / seed_file_stem(1)).with_suffix(suffix)
    path.write_bytes(path.read_bytes()[: int(left * path.stat().st_size)])
    generate(out, episodes=3)
    assert made == [1, 2, 3]
    assert seeds_of(out) == [0, 1, 3]
    assert JsonLinesFile(out / FAILURES_FILE, FailedAttempt).read() == [*lines_of(1), *lines_of(2)]


def test_resume_after_a_kill_after_the_merge(tmp_path, made):
    out = tmp_path / "out"
    generate(out, episodes=2)
    (out / "episodes").mkdir()
    for seed in (0, 1):
        record(out / "episodes", seed)
    generate(out, episodes=3)
    assert seeds_of(out) == [0, 1, 3]
    assert made == [0, 1, 2, 3]


def test_resume_after_a_kill_between_the_two_merged_files(tmp_path, made):
    out = tmp_path / "out"
    generate(out, episodes=2)
    (out / "episodes").mkdir()
    record(out / "episodes", 3)
    data = read_json(out / "trajectory.h5")
    ahead = {**data["episodes"][0], "episode_id": 2, "episode_seed": 3}
    (out / "trajectory.json").write_text(json.dumps({**data, "episodes": [*data["episodes"], ahead]}))
    generate(out, episodes=3)
    assert seeds_of(out) == [0, 1, 3]
    assert made == [0, 1, 2]


def test_request_for_fewer_episodes_than_exist(tmp_path, made):
    out = tmp_path / "out"
    before = generate(out, episodes=4)
    after = generate(out, episodes=2)
    assert seeds_of(out) == [0, 1, 3, 4]
    assert (after.episodes, after.seeds, after.skipped) == (before.episodes, before.seeds, before.skipped)
    assert made == [0, 1, 2, 3, 4]


def test_request_for_fewer_episodes_than_an_interrupted_run_has(tmp_path, made):
    """The episodes were finished for a larger request, so none of them may be deleted."""
    write_killed_run(tmp_path / "out", (0, 1, 3, 4), [*lines_of(1), *lines_of(2), *lines_of(4)])
    started = []
    summary = generate(tmp_path / "out", episodes=2, on_start=started.append)
    assert (started, made) == ([4], [])
    assert seeds_of(tmp_path / "out") == [0, 1, 3, 4]
    assert (summary.episodes, summary.seeds, summary.skipped) == (4, 5, [SKIPPED])


def test_removed_output_folder_is_a_one_line_error(tmp_path, made):
    out = tmp_path / "out"
    with pytest.raises(RobocasError):
        generate(out, episodes=5, on_result=lambda result: shutil.rmtree(out))
    assert made == [0, 1]
