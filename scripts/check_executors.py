"""Runs a plan of pick episodes by each executor and compares what they made; started by check_executors.sh.

python check_executors.py [--episodes 40] [--seed 0] [--jobs 2] [--kill] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import filecmp
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

PRODUCTS = ("demos", "datasets", "statistics", "report.json")
PLAN = """\
description: pick episodes, to compare executors
parts:
  - {{task: pick, episodes: {episodes}, seed: {seed}}}
formats: [robocas, lerobot]
images: {{size: [160, 120]}}
embeddings: false
block: {block}
"""
ROBOCAS = [sys.executable, "-W", "ignore", str(Path(__file__).resolve().parents[1] / "robocas_cli.py")]
MADE = "made"
"""Each run's output in its own folder, where it is run: the statistics say what path they were told."""


@dataclass
class Run:
    """A run of the plan, and how it went; ``kill`` is called when a third of the episodes are there."""

    name: str
    words: list[str]
    kill: Callable[[], str] | None = None
    killed: str = "-"
    seconds: float = 0.0
    wrong: list[str] = field(default_factory=list)

    def do(self, plan: Path, folder: Path, jobs: int, wait_for: int) -> None:
        """Run it in a folder; a run that fails is wrong."""
        words = ["plan", "run", str(plan), "--out", MADE, "--jobs", str(jobs), *self.words]
        print(f"{self.name}: robocas {' '.join(words)}", flush=True)
        folder.mkdir()
        out, begun = folder / MADE, time.monotonic()
        process = subprocess.Popen([*ROBOCAS, *words], cwd=folder)
        try:
            while process.poll() is None:
                time.sleep(0.5)
                if self.kill and self.killed == "-" and seeds_done(out) >= wait_for:
                    self.killed = self.kill()
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(60)
        self.seconds = time.monotonic() - begun
        if process.returncode:
            self.wrong.append(f"ended with {process.returncode}")
        if self.kill and self.killed == "-":
            self.wrong.append("ended before anything was killed")
        self.wrong += left_behind(out)


def seeds_done(out: Path) -> int:
    """Return how many seeds are done, or a few less."""
    return len(list(out.glob("units/*/*/*/outcome.json")))


def left_behind(out: Path) -> list[str]:
    """Return what a finished plan should have deleted of its units."""
    return [f"{path}: left behind" for path in out.glob("units/*/*/*") if path.name != "seeds.jsonl"]


def differences(one: Path, other: Path) -> list[str]:
    """Files of the products that are not the same in both, or only in one."""
    ours, theirs = files(one), files(other)
    found = [f"{path}: only in one" for path in sorted(ours ^ theirs)]
    return found + [f"{path}: differs" for path in sorted(ours & theirs) if not same(one / path, other / path)]


def same(one: Path, other: Path) -> bool:
    """Whether two files have the same bytes."""
    return filecmp.cmp(one, other, shallow=False)


def files(out: Path) -> set[Path]:
    """Paths of all products."""
    found = [path for name in PRODUCTS for path in [out / name, *(out / name).rglob("*")] if path.is_file()]
    return {path.relative_to(out) for path in found}


class Node:
    """A node of Ray on this machine, in a process group of its own."""

    def __init__(self, folder: Path, cores: int, *words: str) -> None:
        ray = str(Path(sys.executable).with_name("ray"))
        store = f"--object-store-memory={200 * 2**20}"
        command = [ray, "start", "--block", f"--num-cpus={cores}", "--disable-usage-stats", store, *words]
        self.log = folder / f"node-{len(list(folder.glob('*.log')))}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)

    def kill(self) -> str:
        """Kill all of its processes at once, as a power cut does."""
        import psutil

        own = psutil.Process(self.process.pid)
        processes = [*own.children(recursive=True), own]
        for process in processes:
            process.suspend()  # none can tell the others
        for process in processes:
            process.kill()
        self.process.wait()
        return f"a node, {len(processes)} processes"

    def end(self) -> None:
        """End it."""
        if self.process.poll() is None:
            self.process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(20)
                return
            self.kill()


@contextmanager
def cluster(cores: int) -> Iterator[tuple[str, Node]]:
    """Start two nodes; gives the address and the second one, and ends them."""
    folder = Path(tempfile.mkdtemp(prefix="rce-", dir="/tmp"))  # paths of sockets are short
    token = folder / "token"  # of this cluster alone, whatever the user's own setting is
    token.touch(0o600)
    token.write_text(secrets.token_hex(32))
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token)}
    port = free_port()
    nodes = []
    try:
        head = ["--head", f"--port={port}", f"--temp-dir={folder}", "--include-dashboard=false"]
        nodes.append(Node(folder, cores, *head))
        address = f"127.0.0.1:{port}"
        wait_for_nodes(address, nodes)
        nodes.append(Node(folder, cores, f"--address={address}"))
        wait_for_nodes(address, nodes)
        yield address, nodes[1]
    finally:
        for node in reversed(nodes):
            node.end()
        shutil.rmtree(folder, ignore_errors=True)


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def wait_for_nodes(address: str, nodes: Sequence[Node]) -> None:
    """Wait until a cluster has these nodes."""
    code = f"import ray; ray.init('{address}', log_to_driver=False, logging_level='ERROR'); print(len(ray.nodes()))"
    until, said = time.monotonic() + 180, ""
    while nodes[-1].process.poll() is None and time.monotonic() < until:
        asked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        if asked.stdout.strip() == str(len(nodes)):
            return
        said = f"{asked.stdout[-500:]}{asked.stderr[-500:]}"
        time.sleep(1)
    sys.exit(f"node {len(nodes)} of Ray did not start: {nodes[-1].log.read_text()[-1000:]}\n{said}")


def kill_job() -> str:
    """Kill the processes of a job of Slurm."""
    asked = ["squeue", "--noheader", "--array", "--me", "--states=RUNNING", "--format=%i %j"]
    found = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.split("\n")
    jobs = [line.split()[0] for line in found if " robocas-" in line]
    if not jobs:
        return "-"
    subprocess.run(["scancel", "--signal=KILL", jobs[0]], check=True)
    return f"job {jobs[0]}"


def main() -> int:
    """Run all, print the table."""
    parser = argparse.ArgumentParser(prog="check_executors.sh")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--out", type=Path, help="keeps what was made")
    parser.add_argument("--from", dest="start", type=Path, default=Path.cwd(), help=argparse.SUPPRESS)
    words = parser.parse_args()
    out = (words.start / words.out).resolve() if words.out else Path(tempfile.mkdtemp(prefix="robocas-executors-"))
    try:
        return compare(out, words.episodes, words.seed, words.jobs, words.kill)
    finally:
        if not words.out:
            shutil.rmtree(out, ignore_errors=True)


def on_ray(address: str, gather: str = "no") -> list[str]:
    """Return the options of a run on a cluster of Ray."""
    options = ["--executor-option", f"address={address}", "--executor-option", f"gather={gather}"]
    return ["--executor", "ray", *options]


def compare(out: Path, episodes: int, seed: int, jobs: int, kill: bool) -> int:
    """Run the plan by each executor into a folder; 1: what they made is not the same."""
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        sys.exit(f"{out}: there is something in it")
    plan = out / "plan.yaml"
    plan.write_text(PLAN.format(episodes=episodes, seed=seed, block=max(1, min(10, episodes // 8))))
    runs: list[Run] = []

    def do(run: Run) -> None:
        folder = out / run.name.replace(" ", "_").replace(",", "")
        run.do(plan, folder, jobs, max(1, episodes // 3))
        if runs:
            run.wrong += differences(out / "local" / MADE, folder / MADE)
        runs.append(run)

    do(Run("local", []))
    slurm = ["--executor", "slurm", "--executor-option", "units_per_job=2"]
    if shutil.which("sinfo") and subprocess.run(["sinfo"], capture_output=True, check=False).returncode == 0:
        do(Run("slurm", slurm))
        if kill:
            do(Run("slurm, a job killed", slurm, kill=kill_job))
    else:
        do(Run("slurm by submitit alone", [*slurm, "--executor-option", "cluster=local"]))
    with cluster(-(-jobs // 2)) as (address, _):
        do(Run("ray", on_ray(address)))
        do(Run("ray, gather", on_ray(address, "yes")))
    for gather in ("no", "yes") if kill else ():
        with cluster(-(-jobs // 2)) as (address, second):
            name = f"ray{', gather' if gather == 'yes' else ''}, a node killed"
            do(Run(name, on_ray(address, gather), kill=second.kill))
    count = len(files(out / "local" / MADE))
    print(f"\n{episodes} pick episodes from seed {seed}, {jobs} jobs, {count} files\n")
    print("| executor | wall, s | killed | same bytes |\n|---|---|---|---|")
    for run in runs:
        print(f"| {run.name} | {run.seconds:.0f} | {run.killed} | {'no' if run.wrong else 'yes'} |")
    for run in runs:
        for line in run.wrong[:10]:
            print(f"{run.name}: {line}", file=sys.stderr)
    return int(any(run.wrong for run in runs) or not count)


if __name__ == "__main__":
    sys.exit(main())
