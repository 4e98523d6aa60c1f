"""Every fault in every command, with real episodes and processes. A line of the table each; see scripts/faults.sh."""

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
    alive,
    begun,
    content,
    environment,
    is_one_line,
    lines_of,
    note,
    readable,
    run,
    running,
    succeed,
    wait_until,
)

from robocas_ms3.evaluation.protocol import load_protocol

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
    """What is run."""
    folder = tmp_path_factory.mktemp("inputs")
    plan, protocol = folder / "plan.yaml", folder / "short"
    plan.write_text(PLAN)
    shutil.copytree(load_protocol("smoke").folder, protocol)
    rules = protocol / "protocol.yaml"
    rules.write_text(rules.read_text().replace("max_steps: null", "max_steps: 60"))
    recorded = folder / "recorded"
    made = {
        "generate": Command("generate", ("generate", "pick", "-n", str(EPISODES))),
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
    succeed(made["generate"].line(recorded))
    return made


@pytest.fixture(scope="session")
def undisturbed(commands, tmp_path_factory):
    """(command) -> what it makes where nothing befalls it."""
    kept = {}

    def of(command):
        if command.name not in kept:
            out = tmp_path_factory.mktemp("undisturbed") / "out"
            started = time.monotonic()
            succeed(command.line(out))
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
    note(found)


def waits(log, key):
    """Seconds between the tries of a task."""
    tries = [when for when, which in begun(log) if which == str(key)]
    return [round(after - before, 1) for before, after in zip(tries, tries[1:], strict=False)]


@pytest.mark.parametrize(("fault", "times"), [("crash", 1), ("crash", 2), ("hang", 1), ("grow", 1)])
def test_a_task_whose_process(command, undisturbed, tmp_path, row, fault, times):
    """Once, it is begun again; twice, it is left out: another seed, an error in the end, or a failed episode."""
    row.fault, row.command, row.injected = f"{fault}{' twice' * (times > 1)}", command.name, times
    log, out = tmp_path / "log", tmp_path / "out"
    limits = command.slow if fault == "hang" else command.large if fault == "grow" else ()
    words = command.line(out, 2, *limits)
    told = {"log": str(log), "at": {"key": command.hit, "fault": fault, "times": times}}
    code, said = run(words, told)
    row.seconds = waits(log, command.hit)
    expected = undisturbed(command)[0]
    if times == 1:
        assert code == 0, said[-2000:]
        row.judge(expected, content(command, out))
        return
    if command.name == "convert":  # an error that names it; what is left goes on
        assert code == 1
        assert "episode_0000001: its process died twice: SIGSEGV" in said
        assert command.finished(out) == EPISODES - 1
        succeed(words)
        row.judge(expected, content(command, out))
        return
    assert code == (command.name == "eval"), said[-2000:]  # an episode with an error: exit status 1
    found = content(command, out)
    row.judge(expected, found, without=(1,))
    if command.name == "eval":
        assert dict(found)[1]["error"] == "the worker process of the env crashed: SIGSEGV"
        row.note = "counted as failed"
    else:
        row.note = "another seed in its place"
        assert len(found) == EPISODES


def test_kill_9_of_all_at_random_moments(command, undisturbed, tmp_path, row):
    row.command, chance = command.name, random.Random(SEED)
    expected, whole = undisturbed(command)
    log, out = tmp_path / "log", tmp_path / "out"
    row.note = f"seed {SEED}"
    while True:
        started = time.monotonic()
        with running(command.line(out, 2), {"log": str(log)}) as process:
            kill = row.injected < KILLS
            try:
                _, said = process.communicate(timeout=chance.uniform(0, 1.1 * whole) if kill else PATIENCE)
            except subprocess.TimeoutExpired:
                row.injected += 1
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            else:
                assert process.returncode == 0, said[-2000:]
                row.judge(expected, content(command, out))
                if not kill:
                    return
                shutil.rmtree(out)
        row.seconds += [round(when - started, 1) for when, _ in begun(log) if when > started][:1]


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c(command, undisturbed, tmp_path, row, times):
    row.fault, row.command, row.injected = "Ctrl-C" + " twice at once" * (times > 1), command.name, 1
    log, out = tmp_path / "log", tmp_path / "out"
    with running(command.line(out, 8), {"log": str(log)}) as process:
        wait_until(lambda: begun(log), process)
        pressed = time.monotonic()
        for _ in range(times):
            os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
        ended = time.monotonic() - pressed
        while alive(process.pid):
            assert time.monotonic() - pressed < 3, alive(process.pid)
        row.note = f"ended after {ended:.1f} s"
        assert ended < 3
    assert process.returncode == 130
    assert len(lines_of(said)) == 1, said
    resumed = time.monotonic()
    succeed(command.line(out, 2), {"log": str(log)})
    row.seconds = [round(when - resumed, 1) for when, _ in begun(log) if when > resumed][:1]
    row.judge(undisturbed(command)[0], content(command, out))


ROOM = """\
set -e
mkdir -p "$1/disk"
mount -t tmpfs -o "size=$2" tmpfs "$1/disk"
shift 2
set +e
"$@" 2>"$0/said"; echo $? >"$0/code"
df --output=avail "$0/disk" >"$0/room"
cp -r "$0/disk/out" "$0/full"
mount -o remount,"$AGAIN" "$0/disk" || exit 9
"$@" 2>"$0/said_after"; echo $? >"$0/code_after"
cp -r "$0/disk/out" "$0/out"
"""


def test_a_full_disk(command, undisturbed, tmp_path, row):
    """A disk of its own, in a namespace, which is made larger then."""
    if subprocess.run(["unshare", "-rm", "true"], check=False).returncode:
        pytest.skip("this machine lets nobody mount anything")
    row.command, row.injected = command.name, 1
    size = {"generate": "500k", "convert": "3m", "plan run": "3500k", "eval": "8k"}[command.name]
    words = ["unshare", "-rm", "sh", "-c", ROOM, str(tmp_path), str(tmp_path), size]
    env = {**environment(), "AGAIN": "size=1g"}
    line = command.line(tmp_path / "disk" / "out", 2)
    subprocess.run([*words, *line], env=env, check=True, timeout=PATIENCE, stdout=subprocess.DEVNULL)
    said = (tmp_path / "said").read_text()
    assert (tmp_path / "code").read_text() == "1\n", said[-2000:]
    assert is_one_line(said) and "No space left on device" in said, said[-2000:]
    row.note = f"{readable(command, tmp_path / 'full')} finished, readable"
    assert (tmp_path / "code_after").read_text() == "0\n", (tmp_path / "said_after").read_text()[-2000:]
    row.judge(undisturbed(command)[0], content(command, tmp_path / "out"))


def make_writable(out, *, yes):
    for path in [out, *out.rglob("*")]:
        path.chmod((0o755 if yes else 0o555) if path.is_dir() else (0o644 if yes else 0o444))


@pytest.mark.parametrize("how", ["vanishes", "becomes read-only"])
def test_an_output_folder_that(command, undisturbed, tmp_path, row, how):
    row.fault, row.command, row.injected = f"output folder {how}", command.name, 1
    log, out, vanishes = tmp_path / "log", tmp_path / "out", how == "vanishes"
    powerless = [] if os.geteuid() else ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]  # root may all
    with running([*powerless, *command.line(out, 2)], {"log": str(log)}) as process:
        wait_until(lambda: begun(log), process)
        hit = time.monotonic()
        if vanishes:
            out.rename(tmp_path / "gone")
        else:
            make_writable(out, yes=False)
        _, said = process.communicate(timeout=PATIENCE)
        row.note = f"ended after {time.monotonic() - hit:.0f} s"
    assert process.returncode == 1, said[-2000:]
    assert is_one_line(said), said[-2000:]
    if not vanishes:
        make_writable(out, yes=True)
        succeed(command.line(out, 2))
        row.judge(undisturbed(command)[0], content(command, out))


def test_a_clock_that_runs_backwards(command, undisturbed, tmp_path, row):
    row.command, row.injected = command.name, 1
    succeed(command.line(tmp_path / "out", 2), {"backwards": True})
    row.judge(undisturbed(command)[0], content(command, tmp_path / "out"))


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def stopped_half_way(command, out, log):
    """A run that was killed with an episode or two done."""
    with running(command.line(out, 2), {"log": str(log)}) as process:
        wait_until(lambda: command.finished(out) >= 1, process)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


CUT = {
    "generate": ("episodes/seed_*.h5", "episodes/seed_*.json"),
    "convert": ("episode_*/episode_info.npz", "episode_*/base_camera/rgb/0001.png", "episode_*/scene.json"),
    "plan run": ("units/*/*/[0-9]*/outcome.json",),
    "eval": ("episodes.jsonl",),
}


@pytest.mark.parametrize(("name", "pattern"), [(name, pattern) for name, of in CUT.items() for pattern in of])
def test_a_file_of_a_run_that_was_cut_off(commands, undisturbed, tmp_path, row, name, pattern):
    """A recording, its JSON, a ledger, an image, arrays: what they held is done again."""
    command, out = commands[name], tmp_path / "out"
    row.command, row.fault = name, f"cut off: {pattern.rpartition('/')[2]}"
    stopped_half_way(command, out, tmp_path / "log")
    for path in out.glob(pattern):
        cut(path)
        row.injected += 1
    assert row.injected
    succeed(command.line(out, 2))
    row.judge(undisturbed(command)[0], content(command, out))


def test_a_layout_cache_that_was_cut_off(commands, undisturbed, tmp_path, row, monkeypatch):
    """Its layouts are made anew."""
    command, cache = commands["generate"], tmp_path / "cache"
    row.command = command.name
    expected = undisturbed(command)[0]
    monkeypatch.setenv("ROBOCAS_CACHE", str(cache))
    succeed(command.line(tmp_path / "before"))
    for path in (path for path in (cache / "layouts").rglob("*") if path.is_file()):
        cut(path)
        row.injected += 1
    assert row.injected
    succeed(command.line(tmp_path / "out"))
    row.judge(expected, content(command, tmp_path / "out"))


def test_two_runs_into_one_folder(command, undisturbed, tmp_path, row):
    row.command, row.injected = command.name, 1
    log, out = tmp_path / "log", tmp_path / "out"
    with running(command.line(out, 2), {"log": str(log)}) as process:
        wait_until(lambda: begun(log), process)
        code, said = run(command.line(out, 2))
        assert code == 1
        assert is_one_line(said) and "another process writes to this folder" in said, said[-2000:]
        assert process.wait(PATIENCE) == 0
    row.judge(undisturbed(command)[0], content(command, out))


@pytest.mark.parametrize("name", COMMANDS)
def test_another_version(commands, tmp_path, row, name):
    """Whoever goes on with one is refused: what comes of it would be of two."""
    command = commands[name]
    row.command, row.injected = name, 1
    log, out = tmp_path / "log", tmp_path / "out"
    stopped_half_way(command, out, log)
    before = command.finished(out)
    code, said = run(command.line(out, 2), {"versions": {"sapien": "2.2.2"}})
    assert code == 1, said[-2000:]
    assert is_one_line(said) and "2.2.2" in said, said[-2000:]
    assert command.finished(out) == before
