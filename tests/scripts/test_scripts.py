"""Scripts: valid syntax, no host names; scripts of baselines call valid commands whose inputs exist at that time."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from robocas_ms3.cli import main as cli
from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.scenes.config import bundled_configs

ROOT = Path(__file__).resolve().parents[2]
STUB = '#!/bin/sh\nprintf "%s\\n" "$*" >> "$CALLS"\n'
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


@pytest.mark.parametrize(
    "path", [path for path in (ROOT / "scripts").iterdir() if path.is_file()], ids=lambda path: path.name
)
def test_no_script_names_a_host_and_shell_scripts_are_valid(path):
    assert not re.search(r"://(?!127\.0\.0\.1)", path.read_text())
    if path.suffix == ".sh":
        subprocess.run(["bash", "-n", path], check=True)


def run_with_stub(tmp_path, script, *more, **settings):
    """Run a script with a stub of `robocas`; return its process and the words of the calls."""
    stub = tmp_path / "robocas"
    stub.write_text(STUB)
    stub.chmod(0o755)
    env = {**os.environ, "ROBOCAS": str(stub), "CALLS": str(tmp_path / "calls"), "JOBS": "2", **settings}
    words = ["bash", str(ROOT / "scripts" / script), *more]
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=False)
    calls = (tmp_path / "calls").read_text().splitlines() if (tmp_path / "calls").is_file() else []
    return done, [line.split() for line in calls]


@pytest.mark.parametrize("words", STEPS)
def test_scripts_call_valid_commands(tmp_path, words):
    folder = tmp_path / "out"
    (folder / "run").mkdir(parents=True)
    (folder / "run" / "weights.safetensors").touch()
    (folder / "eval").mkdir()
    (folder / "eval" / "report.md").touch()
    done, calls = run_with_stub(tmp_path, *words.split(), str(folder), EPISODES="100")
    assert done.returncode == 0, done.stderr
    assert " ".join(call[0] for call in calls) == STEPS[words]
    made = {str(folder / "run"), str(folder / "data")}
    for call in calls:
        cli.parse(call)
        assert call[0] != "generate" or call[call.index("--config") + 1] in bundled_configs()
        read = [word.removesuffix("/trajectory.h5") for word in call if word.startswith(str(folder))]
        out = call[call.index("--out") + 1]
        read.remove(out)
        made.add(out)
        assert set(read) <= made, call
    counts = [int(call[call.index("-n") + 1]) for call in calls if call[0] == "generate"]
    assert sum(counts) == 100


def check_shards(calls):
    """Check that evaluations in two shards, in any order, are followed by their merge; return one shard of each."""
    played = []
    for *shards, merge in zip(calls[0::3], calls[1::3], calls[2::3], strict=True):
        shards.sort(key=lambda call: call[call.index("--shard") + 1])
        folders = [call[call.index("--out") + 1] for call in shards]
        assert [call[call.index("--shard") + 1] for call in shards] == ["0/2", "1/2"]
        assert merge[:4] == ["eval", "merge", *folders[::-1]]
        out = merge[merge.index("--out") + 1]
        assert folders == [f"{out}_shards/{number}" for number in range(2)]
        assert all({"--retry-errors", "processes"} < set(call) for call in shards)
        played.append(shards[0])
    return played


@pytest.mark.parametrize(("row", "parts", "tasks"), [("A", 4, 4), ("B", 3, 2), ("C", 3, 2), ("S", 6, 0)])
def test_rows_of_keyframe_call_valid_commands(tmp_path, row, parts, tasks):
    out = tmp_path / "out"
    done, calls = run_with_stub(tmp_path, "reproduce_keyframe.sh", row, str(out), SCALE="10", STEPS="7", EPISODES="3")
    assert done.returncode == 0, done.stderr
    evaluations = calls[2 * parts + 1 :]
    assert [call[0] for call in calls[: 2 * parts + 1]] == ["generate", "render-candidates"] * parts + ["train"]
    for call in calls:
        cli.parse(call)
    for generate, render in zip(calls[0 : 2 * parts : 2], calls[1 : 2 * parts : 2], strict=True):
        config = generate[generate.index("--config") + 1]
        assert config in bundled_configs() or (ROOT / config).is_file()
        assert 5 <= int(generate[generate.index("-n") + 1]) <= 15
        assert (
            render[1]
            == f"{generate[generate.index('--out') + 1]}/candidates.h5"
            == f"{out}/data/{Path(config).stem}/candidates.h5"
        )
    train = calls[2 * parts]
    assert train[train.index("--data") + 1] == str(out / "data") and train[train.index("--steps") + 1] == "7"
    played = check_shards(evaluations)
    assert len(played) == tasks
    assert all(call[call.index("--policy") + 1] == train[train.index("--out") + 1] for call in played)
    again, _ = run_with_stub(tmp_path, "reproduce_keyframe.sh", row, str(out), SCALE="20")
    assert again.returncode == 2 and "other settings" in again.stderr


@pytest.mark.parametrize(
    ("baseline", "step", "runs"), [("small", "convert", ["run"] * 4), ("bc-state", "train", ["run/pick", "run/select"])]
)
def test_row_a_of_other_baselines_calls_valid_commands(tmp_path, baseline, step, runs):
    out = tmp_path / "out"
    done, calls = run_with_stub(tmp_path, "reproduce_ms3.sh", baseline, str(out), SCALE="10", EPISODES="3")
    assert done.returncode == 0, done.stderr
    for call in calls:
        cli.parse(call)
    assert [call[0] for call in calls[:8]] == ["generate", step] * 4
    for generate, reads in zip(calls[0:8:2], calls[1:8:2], strict=True):
        assert f"{generate[generate.index('--out') + 1]}/trajectory.h5" in reads
        assert generate[generate.index("--config") + 1] in bundled_configs()
    trained = [call[call.index("--out") + 1] for call in calls if call[0] == "train"]
    played = check_shards([call for call in calls[8:] if call[0] == "eval"])
    assert [call[call.index("--protocol") + 1] for call in played] == ["ms3-v1"] * 4
    policies = [call[call.index("--policy") + 1] for call in played]
    assert set(policies) == set(trained)
    assert policies[: len(runs)] == [str(out / baseline / run) for run in runs]


def test_a_policy_is_evaluated_on_all_protocols(tmp_path):
    settings = {"OUT": str(tmp_path / "out"), "TABLE": str(tmp_path / "board" / "rows.json")}
    done, calls = run_with_stub(tmp_path, "evaluate_protocols.sh", "runs/mine", **settings)
    assert done.returncode == 0, done.stderr
    for call in calls:
        cli.parse(call)
    rows = [call for call in calls if call[1] == "table"]
    evaluations = check_shards([call for call in calls if call not in rows])
    played = [call[call.index("--protocol") + 1] for call in evaluations]
    assert sorted(played) == sorted(set(bundled_protocols()) - {"smoke", "clutter-scale-v1", "removal-order-v1"})
    assert [call[2] for call in rows] == [str(tmp_path / "out" / "runs_mine" / name) for name in played]
    assert all("--update" in call and call[-1] == settings["TABLE"] for call in rows)
    assert run_with_stub(tmp_path, "evaluate_protocols.sh")[0].returncode == 2


def test_the_runs_of_a_baseline_are_evaluated_in_their_tasks(tmp_path):
    settings = {"OUT": str(tmp_path / "out"), "TABLE": str(tmp_path / "rows.json")}
    runs = tmp_path / "runs"
    for task in ("pick", "select"):
        (runs / task).mkdir(parents=True)
        (runs / task / "run.json").touch()
    done, calls = run_with_stub(tmp_path, "evaluate_protocols.sh", str(runs), "paper-v1", "furniture-v1", **settings)
    assert done.returncode == 0, done.stderr
    evaluations = check_shards([call for call in calls if call[1] != "table"])
    played = [(call[2], *(call[call.index(name) + 1] for name in ("--policy", "--protocol"))) for call in evaluations]
    pick, select = str(runs / "pick"), str(runs / "select")
    paper = [("pick", pick, "paper-v1"), ("select", select, "paper-v1")]  # select has the episodes of pick there
    assert played == [*paper, ("pick", pick, "furniture-v1")]
    assert len(calls) == 3 * 4  # two shards, their merge, and the rows


def test_policies_are_placed_on_the_clutter_scale_with_those_evaluated_earlier(tmp_path):
    out = tmp_path / "out"
    (out / "earlier").mkdir(parents=True)
    (out / "earlier" / "run.json").touch()
    entries = ("scripted-ee-delta:20:8", "runs/mine")
    done, calls = run_with_stub(tmp_path, "evaluate_clutter_scale.sh", *entries, OUT=str(out), EPISODES="5")
    assert done.returncode == 0, done.stderr
    for call in calls:
        cli.parse(call)
    noisy, own = check_shards(calls[:-1])
    assert noisy[noisy.index("--action-noise") :][:3] == ["--action-noise", "20", "8"]
    assert "--action-noise" not in own and own[own.index("--policy") + 1] == "runs/mine"
    assert {call[call.index("--protocol") + 1] for call in (noisy, own)} == {"clutter-scale-v1"}
    assert calls[-1][1:] == ["clutter-scale", str(out / "earlier"), "--out", str(out / "scale")]


def test_there_are_not_more_shards_than_episodes_of_a_configuration(tmp_path):
    """With 1 episode of each configuration, some of 2 shards of a protocol could have none."""
    done, calls = run_with_stub(
        tmp_path, "evaluate_clutter_scale.sh", "keyframe", OUT=str(tmp_path / "out"), EPISODES="1"
    )
    shards = [call[call.index("--shard") + 1] for call in calls if "--shard" in call]
    assert shards == ["0/1"], done.stderr


def test_an_evaluation_with_a_failed_shard_is_not_merged(tmp_path):
    stub = tmp_path / "fails"
    stub.write_text(STUB + 'case "$*" in *"--shard 1/2"*) exit 1 ;; esac\n')
    stub.chmod(0o755)
    settings = {"OUT": str(tmp_path / "out"), "TABLE": str(tmp_path / "rows.json"), "ROBOCAS": str(stub)}
    done, calls = run_with_stub(tmp_path, "evaluate_protocols.sh", "small", "smoke", **settings)
    assert done.returncode != 0 and [call[1] for call in calls] == ["run", "run"]
    assert "_shards" in done.stderr


def make_dataset(tmp_path, episodes):
    """Return the folder of a reproduction with an empty dataset, the input of a study."""
    data = tmp_path / "out" / "data"
    data.mkdir(parents=True)
    (data / "data_info.json").touch()
    for number in range(episodes):
        (data / f"episode_{number:07d}").mkdir()
    return tmp_path / "out"


@pytest.mark.parametrize("what", STUDY)
def test_study_trains_on_the_dataset_or_on_a_fraction(tmp_path, what):
    folder = make_dataset(tmp_path, 100)
    done, calls = run_with_stub(tmp_path, "study_small.sh", str(folder), what, EPISODES="7", STEPS="9")
    assert done.returncode == 0, done.stderr
    assert [call[0] for call in calls] == STUDY[what]
    for call in calls:
        cli.parse(call)
    train, evaluation = calls[-2:]
    whole = what != "25"
    assert Path(train[train.index("--data") + 1]) == folder / ("data" if whole else "study/25/data/part_0")
    assert train[train.index("--steps") + 1] == "9"
    assert evaluation[evaluation.index("--policy") + 1] == train[train.index("--out") + 1]
    assert evaluation[evaluation.index("--episodes") + 1] == "7"
    if not whole:
        shares = [float(share) for share in calls[0][calls[0].index("--fractions") + 1 :][:2]]
        assert shares == [0.25, 0.75]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["study_small.sh", "nowhere"], "nowhere: no dataset. Run: bash scripts/reproduce_small.sh pick nowhere"),
        (["reproduce_small.sh"], "invalid task ''"),
        (["reproduce_keyframe.sh", "D"], "invalid row 'D'"),
        (["reproduce_ms3.sh", "ppo"], "invalid baseline 'ppo'"),
        (["reproduce_small.sh", "open_pick"], "invalid task 'open_pick'"),
        (
            ["dagger_small.sh", "pick", "nowhere"],
            "nowhere: no finished run (missing eval/report.md). Run: bash scripts/reproduce_small.sh pick",
        ),
    ],
)
def test_scripts_refuse_invalid_arguments(tmp_path, words, message):
    done, calls = run_with_stub(tmp_path, *words)
    assert (done.returncode, calls) == (2, [])
    assert message in done.stderr


SCRIPTS_WITH_OPTIONS = [
    "reproduce_keyframe.sh A",
    "reproduce_ms3.sh small",
    "reproduce_small.sh pick",
    "dagger_small.sh pick",
    "evaluate_protocols.sh noop",
]


@pytest.mark.parametrize("words", SCRIPTS_WITH_OPTIONS)
def test_invalid_numbers_are_refused_before_anything_is_recorded(tmp_path, words):
    script, *more = words.split()
    for value in ("abc", "0", "-1", "1.5"):
        done, calls = run_with_stub(tmp_path, script, *more, str(tmp_path / "out"), EPISODES=value)
        assert (done.returncode, calls) == (2, []) and "EPISODES" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", SCRIPTS_WITH_OPTIONS)
def test_help_is_the_first_comment(tmp_path, words):
    script, *more = words.split()
    done, calls = run_with_stub(tmp_path, script, *more, "--help")
    assert (done.returncode, calls) == (0, []) and f"bash scripts/{script}" in done.stdout
    assert "set -euo" not in done.stdout


def test_ci_names_the_audit_that_exceeds_its_time_limit(tmp_path):
    """Incident: the run ended with exit status 124 and no message."""
    root = tmp_path / "clone"
    shutil.copytree(ROOT / ".ci", root / ".ci")
    stubs = {"scripts/test.sh": "", "scripts/setup.sh": "", ".venv-numpy1/bin/python": ""}
    for name, lines in {**stubs, "scripts/audit_entries.sh": "exit 124"}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"#!/bin/sh\n{lines}\n")
        (root / name).chmod(0o755)
    settings = ["-c", "user.name=test", "-c", "user.email=test", "-c", "commit.gpgsign=false"]
    for words in (["init"], ["add", "--all"], ["commit", "--message", "first"]):
        subprocess.run(["git", *settings, *words], cwd=root, check=True, capture_output=True)
    env = {**os.environ, "AUDIT_BASE": "HEAD"}
    done = subprocess.run(["bash", root / ".ci" / "run"], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 124
    assert "300 s" in done.stderr and "scripts/audit_entries.sh HEAD" in done.stderr


def test_changed_entries_are_audited(tmp_path):
    root, stub = tmp_path / "clone", tmp_path / "robocas"
    stub.write_text(STUB)
    stub.chmod(0o755)
    shutil.copytree(ROOT / "scripts", root / "scripts")

    def write(*names):
        for name in names:
            (root / "leaderboard" / name).parent.mkdir(parents=True, exist_ok=True)
            (root / "leaderboard" / name).write_text(f"{len(names)}")

    def git(*words):
        settings = ["-c", "user.name=test", "-c", "user.email=test", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *settings, *words], cwd=root, check=True, capture_output=True)

    def audit(*words, **settings):
        (tmp_path / "calls").unlink(missing_ok=True)
        env = {**os.environ, "ROBOCAS": str(stub), "CALLS": str(tmp_path / "calls"), **settings}
        command = ["bash", str(root / "scripts" / "audit_entries.sh"), *words]
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        return done.returncode, (tmp_path / "calls").read_text() if (tmp_path / "calls").exists() else ""

    write("a/README.md", "a/p1/run.json", "a/p2/run.json", "b/p1/run.json", "b/p1/actions/000001.npz")
    git("init")
    git("add", "--all")
    git("commit", "--message", "first")
    assert audit("HEAD") == (0, "")
    assert audit() == audit("nosuch") == audit("HEAD", SAMPLE="0") == (2, "")
    write("b/p1/actions/000001.npz")
    assert audit("HEAD", SAMPLE="5") == (0, "leaderboard audit leaderboard/b/p1 --sample 5\n")
    write("a/README.md")
    git("commit", "--all", "--message", "second")
    expected = "leaderboard audit leaderboard/a leaderboard/b/p1\n"
    assert audit("HEAD~1") == (0, expected)
    write("é/p 1/run.json")  # not committed, and with a name that git and shells quote
    assert audit("HEAD") == (0, "leaderboard audit leaderboard/é/p 1\n")
