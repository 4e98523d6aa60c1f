"""Each fault in each command, with real episodes and processes. A test writes a row of the table of faults.sh."""

import os
import random
import shutil
import signal
import subprocess
import time

import pytest
from faults import (
    EPISODES,
    PATIENCE,
    Command,
    Row,
    content,
    count_readable,
    environment,
    is_single_error,
    lines_without_progress,
    live_processes,
    run,
    run_successfully,
    running_command,
    task_starts,
    wait_until,
    write_row,
)

from robocas_ms3.evaluation.protocols.protocol import load_protocol

pytestmark = pytest.mark.faults
COMMANDS = ("generate", "convert", "plan run", "eval")
KILLS = int(os.environ.get("ROBOCAS_FAULT_KILLS", "20"))
SEED = int(os.environ.get("ROBOCAS_FAULT_SEED", "0")) or random.SystemRandom().randrange(10**6)
PLAN = """\
parts: [{task: pick, config: pick_table_scattered, episodes: 4, name: a}]
stages: [demonstrations, datasets]
images: {size: [64, 48], depth: false}
embeddings: false
block: 2
limits: {record_seconds: 45, render_seconds: 600, memory_gb: 1.5}
"""


@pytest.fixture(scope="session")
def commands(tmp_path_factory):
    """Return the commands by name."""
    folder = tmp_path_factory.mktemp("inputs")
    plan, protocol = folder / "plan.yaml", folder / "short"
    plan.write_text(PLAN)
    shutil.copytree(load_protocol("smoke").folder, protocol)
    rules = protocol / "protocol.yaml"
    rules.write_text(rules.read_text().replace("max_steps: null", "max_steps: 60"))
    recorded = folder / "recorded"
    made = {
        "generate": Command(
            "generate", ("generate", "pick", "-n", str(EPISODES), "--record-candidates", "--candidates", "2")
        ),
        "convert": Command(
            "convert",
            ("convert", str(recorded / "trajectory.h5"), "--size", "64", "48", "--no-depth")
            + ("--no-embeddings", "--no-video"),
        ),
        "plan run": Command("plan run", ("plan", "run", str(plan)), slow=(), large=()),
        "eval": Command(
            "eval",
            ("eval", "pick", "select", "--protocol", str(protocol), "--policy", "random", "--backend", "processes"),
            jobs="--envs",
            slow=("--step-seconds", "30"),
            hit=load_protocol("smoke").episodes[1].seed,
        ),
    }
    run_successfully(made["generate"].line(recorded))
    return made


@pytest.fixture(scope="session")
def expected_content(commands, tmp_path_factory):
    """Return a function (command) -> (content, seconds) of a run without faults."""
    kept = {}

    def of(command):
        if command.name not in kept:
            out = tmp_path_factory.mktemp("expected_content") / "out"
            started = time.monotonic()
            run_successfully(command.line(out))
            kept[command.name] = content(command, out), time.monotonic() - started
            assert len(kept[command.name][0]) == EPISODES
        return kept[command.name]

    return of


@pytest.fixture(params=COMMANDS)
def command(request, commands):
    return commands[request.param]


@pytest.fixture
def row(request):
    found = Row(request.node.originalname.removeprefix("test_").replace("_", " "), "")
    yield found
    write_row(found)


def delays(log, key):
    """Return the seconds between the starts of a task."""
    tries = [when for when, which in task_starts(log) if which == str(key)]
    return [round(after - before, 1) for before, after in zip(tries, tries[1:], strict=False)]


@pytest.mark.parametrize(("fault", "times"), [("crash", 1), ("crash", 2), ("hang", 1), ("grow", 1)])
def test_task_process(command, expected_content, tmp_path, row, fault, times):
    """After one fault the task is retried; after two it is skipped: another seed, an error, or a failed episode."""
    row.fault, row.command, row.injected = f"{fault}{' twice' * (times > 1)}", command.name, times
    log, out = tmp_path / "log", tmp_path / "out"
    limits = command.slow if fault == "hang" else command.large if fault == "grow" else ()
    words = command.line(out, 2, *limits)
    injection = {"log": str(log), "at": {"key": command.hit, "fault": fault, "times": times}}
    code, stderr = run(words, injection)
    row.seconds = delays(log, command.hit)
    expected = expected_content(command)[0]
    if times == 1:
        assert code == 0, stderr[-2000:]
        row.compare(expected, content(command, out))
        return
    if command.name == "convert":  # an error names the episode; the other episodes are converted
        assert code == 1
        assert "episode_0000001: its worker process crashed twice: SIGSEGV" in stderr
        assert command.finished(out) == EPISODES - 1
        run_successfully(words)
        row.compare(expected, content(command, out))
        return
    assert code == (command.name == "eval"), stderr[-2000:]  # an episode with an error: exit status 1
    found = content(command, out)
    row.compare(expected, found, without=(1,))
    if command.name == "eval":
        assert dict(found)[1]["error"] == "the worker process crashed: SIGSEGV"
        row.note = "counted as failed"
    else:
        row.note = "another seed in its place"
        assert len(found) == EPISODES


def test_kill_9_of_all_at_random_times(command, expected_content, tmp_path, row):
    row.command, chance = command.name, random.Random(SEED)
    expected, whole = expected_content(command)
    log, out = tmp_path / "log", tmp_path / "out"
    row.note = f"seed {SEED}"
    while True:
        started = time.monotonic()
        with running_command(command.line(out, 2), {"log": str(log)}) as process:
            kill = row.injected < KILLS
            try:
                _, stderr = process.communicate(timeout=chance.uniform(0, 1.1 * whole) if kill else PATIENCE)
            except subprocess.TimeoutExpired:
                row.injected += 1
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            else:
                assert process.returncode == 0, stderr[-2000:]
                row.compare(expected, content(command, out))
                if not kill:
                    return
                shutil.rmtree(out)
        row.seconds += [round(when - started, 1) for when, _ in task_starts(log) if when > started][:1]


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c(command, expected_content, tmp_path, row, times):
    row.fault, row.command, row.injected = "Ctrl-C" + " twice at once" * (times > 1), command.name, 1
    log, out = tmp_path / "log", tmp_path / "out"
    with running_command(command.line(out, 8), {"log": str(log)}) as process:
        wait_until(lambda: task_starts(log), process)
        pressed = time.monotonic()
        for _ in range(times):
            os.killpg(process.pid, signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
        ended = time.monotonic() - pressed
        while live_processes(process.pid):
            assert time.monotonic() - pressed < 3, live_processes(process.pid)
        row.note = f"ended after {ended:.1f} s"
        assert ended < 3
    assert process.returncode == 130
    assert len(lines_without_progress(stderr)) == 1, stderr
    resumed = time.monotonic()
    run_successfully(command.line(out, 2), {"log": str(log)})
    row.seconds = [round(when - resumed, 1) for when, _ in task_starts(log) if when > resumed][:1]
    row.compare(expected_content(command)[0], content(command, out))


ROOM = """\
set -e
mkdir -p "$1/disk"
mount -t tmpfs -o "size=$2" tmpfs "$1/disk"
shift 2
set +e
"$@" 2>"$0/stderr"; echo $? >"$0/code"
df --output=avail "$0/disk" >"$0/room"
cp -r "$0/disk/out" "$0/full"
mount -o remount,"$AGAIN" "$0/disk" || exit 9
"$@" 2>"$0/said_after"; echo $? >"$0/code_after"
cp -r "$0/disk/out" "$0/out"
"""


def test_full_disk(command, expected_content, tmp_path, row):
    """A small disk, mounted in a namespace, is enlarged after the error."""
    if subprocess.run(["unshare", "-rm", "true"], check=False).returncode:
        pytest.skip("this machine does not allow mounts in a namespace")
    row.command, row.injected = command.name, 1
    size = {"generate": "500k", "convert": "3m", "plan run": "3500k", "eval": "16k"}[command.name]
    words = ["unshare", "-rm", "sh", "-c", ROOM, str(tmp_path), str(tmp_path), size]
    env = {**environment(), "AGAIN": "size=1g"}
    line = command.line(tmp_path / "disk" / "out", 2)
    subprocess.run([*words, *line], env=env, check=True, timeout=PATIENCE, stdout=subprocess.DEVNULL)
    stderr = (tmp_path / "stderr").read_text()
    assert (tmp_path / "code").read_text() == "1\n", stderr[-2000:]
    assert is_single_error(stderr) and "No space left on device" in stderr, stderr[-2000:]
    row.note = f"{count_readable(command, tmp_path / 'full')} finished, readable"
    assert (tmp_path / "code_after").read_text() == "0\n", (tmp_path / "said_after").read_text()[-2000:]
    row.compare(expected_content(command)[0], content(command, tmp_path / "out"))


def make_writable(out, *, yes):
    for path in [out, *out.rglob("*")]:
        path.chmod((0o755 if yes else 0o555) if path.is_dir() else (0o644 if yes else 0o444))


@pytest.mark.parametrize("how", ["vanishes", "becomes read-only"])
def test_output_folder(command, expected_content, tmp_path, row, how):
    row.fault, row.command, row.injected = f"output folder {how}", command.name, 1
    log, out, vanishes = tmp_path / "log", tmp_path / "out", how == "vanishes"
    # root ignores permissions
    drop_privileges = [] if os.geteuid() else ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]
    with running_command([*drop_privileges, *command.line(out, 2)], {"log": str(log)}) as process:
        wait_until(lambda: task_starts(log), process)
        hit = time.monotonic()
        if vanishes:
            out.rename(tmp_path / "gone")
        else:
            make_writable(out, yes=False)
        _, stderr = process.communicate(timeout=PATIENCE)
        row.note = f"ended after {time.monotonic() - hit:.0f} s"
    assert process.returncode == 1, stderr[-2000:]
    assert is_single_error(stderr), stderr[-2000:]
    if not vanishes:
        make_writable(out, yes=True)
        run_successfully(command.line(out, 2))
        row.compare(expected_content(command)[0], content(command, out))


def test_clock_runs_backwards(command, expected_content, tmp_path, row):
    row.command, row.injected = command.name, 1
    run_successfully(command.line(tmp_path / "out", 2), {"backwards": True})
    row.compare(expected_content(command)[0], content(command, tmp_path / "out"))


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def kill_after_one_episode(command, out, log):
    """Start a run and kill it when an episode is finished."""
    with running_command(command.line(out, 2), {"log": str(log)}) as process:
        wait_until(lambda: command.finished(out) >= 1, process)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


TRUNCATED = {
    "generate": ("episodes/seed_*.h5", "episodes/seed_*.json", "episodes/candidates_*.h5"),
    "convert": ("episode_*/episode_info.npz", "episode_*/base_camera/rgb/0001.png", "episode_*/scene.json"),
    "plan run": ("units/*/*/[0-9]*/outcome.json",),
    "eval": ("episodes.jsonl",),
}


@pytest.mark.parametrize(("name", "pattern"), [(name, pattern) for name, of in TRUNCATED.items() for pattern in of])
def test_truncated_file_of_a_run(commands, expected_content, tmp_path, row, name, pattern):
    """The episodes of a truncated recording, JSON file, image or array file are produced again."""
    command, out = commands[name], tmp_path / "out"
    row.command, row.fault = name, f"truncated: {pattern.rpartition('/')[2]}"
    kill_after_one_episode(command, out, tmp_path / "log")
    for path in out.glob(pattern):
        truncate(path)
        row.injected += 1
    assert row.injected
    run_successfully(command.line(out, 2))
    row.compare(expected_content(command)[0], content(command, out))


def test_truncated_layout_cache(commands, expected_content, tmp_path, row, monkeypatch):
    """Its layouts are sampled again."""
    command, cache = commands["generate"], tmp_path / "cache"
    row.command = command.name
    expected = expected_content(command)[0]
    monkeypatch.setenv("ROBOCAS_CACHE", str(cache))
    run_successfully(command.line(tmp_path / "before"))
    for path in (path for path in (cache / "layouts").rglob("*") if path.is_file()):
        truncate(path)
        row.injected += 1
    assert row.injected
    run_successfully(command.line(tmp_path / "out"))
    row.compare(expected, content(command, tmp_path / "out"))


def test_two_runs_into_one_folder(command, expected_content, tmp_path, row):
    row.command, row.injected = command.name, 1
    log, out = tmp_path / "log", tmp_path / "out"
    with running_command(command.line(out, 2), {"log": str(log)}) as process:
        wait_until(lambda: task_starts(log), process)
        code, stderr = run(command.line(out, 2))
        assert code == 1
        assert is_single_error(stderr) and "another process writes to this folder" in stderr, stderr[-2000:]
        assert process.wait(PATIENCE) == 0
    row.compare(expected_content(command)[0], content(command, out))


@pytest.mark.parametrize("name", COMMANDS)
def test_another_version(commands, tmp_path, row, name):
    """A run cannot be continued with another version of a package: its files would be from two versions."""
    command = commands[name]
    row.command, row.injected = name, 1
    log, out = tmp_path / "log", tmp_path / "out"
    kill_after_one_episode(command, out, log)
    before = command.finished(out)
    code, stderr = run(command.line(out, 2), {"versions": {"sapien": "2.2.2"}})
    assert code == 1, stderr[-2000:]
    assert is_single_error(stderr) and "2.2.2" in stderr, stderr[-2000:]
    assert command.finished(out) == before
