"""Run a plan of pick episodes with each executor and compare the files; called by check_executors.sh.

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
OUTPUT = "made"
"""Output folder relative to the folder of each run: statistics record this path, so it must be the same."""


@dataclass
class Run:
    """A run of the plan; ``kill`` is called when a third of the episodes are recorded."""

    name: str
    words: list[str]
    kill: Callable[[], str] | None = None
    killed: str = "-"
    seconds: float = 0.0
    errors: list[str] = field(default_factory=list)

    def execute(self, plan: Path, folder: Path, jobs: int, wait_for: int) -> None:
        """Run the plan in a folder; add a failure to `errors`."""
        words = ["plan", "run", str(plan), "--out", OUTPUT, "--jobs", str(jobs), *self.words]
        print(f"{self.name}: robocas {' '.join(words)}", flush=True)
        folder.mkdir()
        out, start = folder / OUTPUT, time.monotonic()
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
        self.seconds = time.monotonic() - start
        if process.returncode:
            self.errors.append(f"exit status {process.returncode}")
        if self.kill and self.killed == "-":
            self.errors.append("the run ended before a process was killed")
        self.errors += leftover_files(out)


def seeds_done(out: Path) -> int:
    """Return the number of finished seeds; the newest few may be missing."""
    return len(list(out.glob("units/*/*/*/outcome.json")))


def leftover_files(out: Path) -> list[str]:
    """Return the files of work units that a finished plan should have deleted."""
    return [f"{path}: not deleted" for path in out.glob("units/*/*/*") if path.name != "seeds.jsonl"]


def differences(first: Path, second: Path) -> list[str]:
    """Return the output files that differ between two runs, or that only one run has."""
    ours, theirs = files(first), files(second)
    found = [f"{path}: in one folder only" for path in sorted(ours ^ theirs)]
    return found + [f"{path}: differs" for path in sorted(ours & theirs) if not is_equal(first / path, second / path)]


def is_equal(first: Path, second: Path) -> bool:
    """Return whether two files have the same bytes."""
    return filecmp.cmp(first, second, shallow=False)


def files(out: Path) -> set[Path]:
    """Return the paths of all output files, relative to the folder of a run."""
    found = [path for name in PRODUCTS for path in [out / name, *(out / name).rglob("*")] if path.is_file()]
    return {path.relative_to(out) for path in found}


class Node:
    """A Ray node on this machine, in its own process group."""

    def __init__(self, folder: Path, cores: int, *words: str) -> None:
        ray = str(Path(sys.executable).with_name("ray"))
        store = f"--object-store-memory={200 * 2**20}"
        command = [ray, "start", "--block", f"--num-cpus={cores}", "--disable-usage-stats", store, *words]
        self.log = folder / f"node-{len(list(folder.glob('*.log')))}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)

    def kill(self) -> str:
        """Kill all processes of the node at once, like a power failure; return what was killed."""
        import psutil

        own = psutil.Process(self.process.pid)
        processes = [*own.children(recursive=True), own]
        for process in processes:
            process.suspend()  # so that no process can notify another one
        for process in processes:
            process.kill()
        self.process.wait()
        return f"a node, {len(processes)} processes"

    def end(self) -> None:
        """Stop the node."""
        if self.process.poll() is None:
            self.process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(20)
                return
            self.kill()


@contextmanager
def cluster(cores: int) -> Iterator[tuple[str, Node]]:
    """Start a cluster of two nodes, yield its address and the second node, and stop it."""
    folder = Path(tempfile.mkdtemp(prefix="rce-", dir="/tmp"))  # paths of sockets are short
    token = folder / "token"  # only for this cluster; it overrides the setting of the user
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
    """Return a free port."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def wait_for_nodes(address: str, nodes: Sequence[Node]) -> None:
    """Wait until all nodes have joined the cluster; exit if the last one does not."""
    code = f"import ray; ray.init('{address}', log_to_driver=False, logging_level='ERROR'); print(len(ray.nodes()))"
    deadline, output = time.monotonic() + 180, ""
    while nodes[-1].process.poll() is None and time.monotonic() < deadline:
        query = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        if query.stdout.strip() == str(len(nodes)):
            return
        output = f"{query.stdout[-500:]}{query.stderr[-500:]}"
        time.sleep(1)
    sys.exit(f"Ray node {len(nodes)} did not start: {nodes[-1].log.read_text()[-1000:]}\n{output}")


def kill_job() -> str:
    """Kill the processes of a Slurm job; return its name, or "-" if none runs."""
    command = ["squeue", "--noheader", "--array", "--me", "--states=RUNNING", "--format=%i %j"]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")
    jobs = [line.split()[0] for line in found if " robocas-" in line]
    if not jobs:
        return "-"
    subprocess.run(["scancel", "--signal=KILL", jobs[0]], check=True)
    return f"job {jobs[0]}"


def main() -> int:
    """Run the plan with all executors and print the table."""
    parser = argparse.ArgumentParser(prog="check_executors.sh")
    parser.add_argument("--episodes", type=int, default=40, help="number of pick episodes")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    parser.add_argument("--jobs", type=int, default=2, help="number of jobs of each executor")
    parser.add_argument("--kill", action="store_true", help="repeat each run and kill a job or a node during it")
    parser.add_argument("--out", type=Path, help="folder for the files of the runs (default: a temporary folder)")
    parser.add_argument("--from", dest="start", type=Path, default=Path.cwd(), help=argparse.SUPPRESS)
    words = parser.parse_args()
    out = (words.start / words.out).resolve() if words.out else Path(tempfile.mkdtemp(prefix="robocas-executors-"))
    try:
        return compare(out, words.episodes, words.seed, words.jobs, words.kill)
    finally:
        if not words.out:
            shutil.rmtree(out, ignore_errors=True)


def ray_options(address: str, gather: str = "no") -> list[str]:
    """Return the options of a run on a Ray cluster."""
    options = ["--executor-option", f"address={address}", "--executor-option", f"gather={gather}"]
    return ["--executor", "ray", *options]


def compare(out: Path, episodes: int, seed: int, jobs: int, kill: bool) -> int:
    """Run the plan with each executor; return 1 if files differ, else 0."""
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        sys.exit(f"--out {out}: the folder is not empty")
    plan = out / "plan.yaml"
    plan.write_text(PLAN.format(episodes=episodes, seed=seed, block=max(1, min(10, episodes // 8))))
    runs: list[Run] = []

    def execute(run: Run) -> None:
        folder = out / run.name.replace(" ", "_").replace(",", "")
        run.execute(plan, folder, jobs, max(1, episodes // 3))
        if runs:
            run.errors += differences(out / "local" / OUTPUT, folder / OUTPUT)
        runs.append(run)

    execute(Run("local", []))
    slurm = ["--executor", "slurm", "--executor-option", "units_per_job=2"]
    if shutil.which("sinfo") and subprocess.run(["sinfo"], capture_output=True, check=False).returncode == 0:
        execute(Run("slurm", slurm))
        if kill:
            execute(Run("slurm, one job killed", slurm, kill=kill_job))
    else:
        execute(Run("slurm, local processes of submitit", [*slurm, "--executor-option", "cluster=local"]))
    with cluster(-(-jobs // 2)) as (address, _):
        execute(Run("ray", ray_options(address)))
        execute(Run("ray, gather", ray_options(address, "yes")))
    for gather in ("no", "yes") if kill else ():
        with cluster(-(-jobs // 2)) as (address, second):
            name = f"ray{', gather' if gather == 'yes' else ''}, one node killed"
            execute(Run(name, ray_options(address, gather), kill=second.kill))
    count = len(files(out / "local" / OUTPUT))
    print(f"\n{episodes} pick episodes from seed {seed}, {jobs} jobs, {count} files\n")
    print("| executor | wall, s | killed | same bytes |\n|---|---|---|---|")
    for run in runs:
        print(f"| {run.name} | {run.seconds:.0f} | {run.killed} | {'no' if run.errors else 'yes'} |")
    for run in runs:
        for line in run.errors[:10]:
            print(f"{run.name}: {line}", file=sys.stderr)
    return int(any(run.errors for run in runs) or not count)


if __name__ == "__main__":
    sys.exit(main())
