"""What the scripts of `small` call are commands that there are, in an order in which each finds its input."""

import os
import subprocess
from pathlib import Path

import pytest

from robocas_ms3.cli import main as cli
from robocas_ms3.scenes.config import shipped_configs

ROOT = Path(__file__).resolve().parents[2]
STUB = '#!/bin/sh\nprintf "%s\\n" "$*" >> "$CALLS"\n[ "$1" != "$BREAKS" ] || exit 130\n'
STEPS = {
    "reproduce_small.sh pick": "generate convert merge train eval",
    "reproduce_small.sh select": "generate convert generate convert merge train eval",
    "reproduce_small.sh search": "generate convert generate convert generate convert merge train eval",
    "dagger_small.sh pick": "generate convert merge train eval",
    "dagger_small.sh search": "generate convert merge train eval",
}
STUDY = {
    "all": ["train", "eval"],
    "25": ["split", "train", "eval"],
    "no-language": ["train", "eval"],
    "no-gripper-camera": ["train", "eval"],
}


def called(tmp_path, script, *more, **settings):
    stub = tmp_path / "robocas"
    stub.write_text(STUB)
    stub.chmod(0o755)
    env = {**os.environ, "ROBOCAS": str(stub), "CALLS": str(tmp_path / "calls"), "JOBS": "2", **settings}
    words = ["bash", str(ROOT / "scripts" / script), *more]
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=False)
    calls = (tmp_path / "calls").read_text().splitlines() if (tmp_path / "calls").is_file() else []
    return done, [line.split() for line in calls]


@pytest.mark.parametrize("words", STEPS)
def test_they_call_what_there_is(tmp_path, words):
    folder = tmp_path / "out"
    (folder / "run").mkdir(parents=True)
    (folder / "run" / "weights.safetensors").touch()
    (folder / "eval").mkdir()
    (folder / "eval" / "report.md").touch()
    done, calls = called(tmp_path, *words.split(), str(folder), EPISODES="100")
    assert done.returncode == 0, done.stderr
    assert " ".join(call[0] for call in calls) == STEPS[words]
    made = {str(folder / "run"), str(folder / "data")}
    for call in calls:
        cli.parse(call)
        assert call[0] != "generate" or call[call.index("--config") + 1] in shipped_configs()
        read = [word.removesuffix("/trajectory.h5") for word in call if word.startswith(str(folder))]
        out = call[call.index("--out") + 1]
        read.remove(out)
        made.add(out)
        assert set(read) <= made, call
    counts = [int(call[call.index("-n") + 1]) for call in calls if call[0] == "generate"]
    assert sum(counts) == 100


def test_takeovers_are_from_a_run_that_came_to_its_end(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "weights.safetensors").touch()  # there from the first checkpoint on
    done, calls = called(tmp_path, "dagger_small.sh", "pick", str(tmp_path))
    assert (done.returncode, calls) == (2, [])
    assert "no run that was trained to its end" in done.stderr


def reproduced(tmp_path, episodes):
    """A folder as the trainings of a study need it."""
    data = tmp_path / "out" / "data"
    data.mkdir(parents=True)
    (data / "data_info.json").touch()
    for number in range(episodes):
        (data / f"episode_{number:07d}").mkdir()
    return tmp_path / "out"


def test_what_breaks_off_is_gone_on_with_by_the_same_call(tmp_path):
    done, calls = called(tmp_path, "reproduce_small.sh", "pick", str(tmp_path / "out"), BREAKS="convert")
    assert done.returncode == 130
    assert [call[0] for call in calls] == ["generate", "convert"]
    assert "reproduce_small: convert ended with 130; what is there is kept, and the same call goes on" in done.stderr


def test_what_is_there_is_not_mixed_with_other_episodes(tmp_path):
    out = str(tmp_path / "out")
    first, calls = called(tmp_path, "reproduce_small.sh", "pick", out, EPISODES="12")
    assert (first.returncode, calls[0][0]) == (0, "generate")
    again, _ = called(tmp_path, "reproduce_small.sh", "pick", out, EPISODES="12")
    assert again.returncode == 0
    before = (tmp_path / "calls").read_text()
    other, _ = called(tmp_path, "reproduce_small.sh", "pick", out, EPISODES="14")
    assert other.returncode == 2
    assert "was begun with EPISODES=12 SEED=510000, not EPISODES=14" in other.stderr
    assert (tmp_path / "calls").read_text() == before


@pytest.mark.parametrize("what", STUDY)
def test_a_study_trains_on_what_is_there_and_on_parts_of_it(tmp_path, what):
    folder = reproduced(tmp_path, 100)
    done, calls = called(tmp_path, "study_small.sh", str(folder), what, EPISODES="7", STEPS="9")
    assert done.returncode == 0, done.stderr
    assert [call[0] for call in calls] == STUDY[what]
    for call in calls:
        cli.parse(call)
    train, played = calls[-2:]
    whole = what != "25"
    assert Path(train[train.index("--data") + 1]) == folder / ("data" if whole else "study/25/data/part_0")
    assert train[train.index("--steps") + 1] == "9"
    assert played[played.index("--policy") + 1] == train[train.index("--out") + 1]
    assert played[played.index("--episodes") + 1] == "7"
    if not whole:
        shares = [float(share) for share in calls[0][calls[0].index("--parts") + 1 :][:2]]
        assert shares == [0.25, 0.75]


@pytest.mark.parametrize("what", ["10", "11", "0", "5x", "no-words"])
def test_a_study_refuses_what_it_does_not_know(tmp_path, what):
    done, calls = called(tmp_path, "study_small.sh", str(reproduced(tmp_path, 10)), "all", what)
    assert (done.returncode, calls) == (2, [])
    assert f"study_small: error: {what}: " in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["study_small.sh", "nowhere"], "nowhere: no data; bash scripts/reproduce_small.sh pick nowhere makes it"),
        (["reproduce_small.sh"], "which task?"),
        (["reproduce_small.sh", "open_pick"], "which task?"),
        (
            ["dagger_small.sh", "pick", "nowhere"],
            "nowhere: no run that was trained to its end; bash scripts/reproduce_small.sh pick",
        ),
    ],
)
def test_what_they_refuse(tmp_path, words, said):
    done, calls = called(tmp_path, *words)
    assert (done.returncode, calls) == (2, [])
    assert said in done.stderr


def test_few_episodes_are_shared_among_the_parts_that_get_one(tmp_path):
    _, calls = called(tmp_path, "reproduce_small.sh", "search", str(tmp_path / "out"), EPISODES="7")
    recorded = [(call[1], int(call[call.index("-n") + 1])) for call in calls if call[0] == "generate"]
    assert recorded == [("pick", 4), ("search", 3)]  # of 65, 13 and 22 percent


def test_processes_are_one_a_core_whatever_torch_is_told(tmp_path):
    _, calls = called(tmp_path, "reproduce_small.sh", "pick", str(tmp_path / "out"), JOBS="", OMP_NUM_THREADS="1")
    jobs = {call[call.index("--jobs") + 1] for call in calls if "--jobs" in call}
    assert jobs == {str(len(os.sched_getaffinity(0)))}


def test_a_study_leaves_out_what_it_is_about(tmp_path):
    _, calls = called(tmp_path, "study_small.sh", str(reproduced(tmp_path, 10)), "no-language", "no-gripper-camera")
    settings = [call[call.index("--set") + 1] for call in calls if call[0] == "train"]
    assert settings == ["language=false", "views.gripper_camera=null"]
