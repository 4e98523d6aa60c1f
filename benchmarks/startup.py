"""Measure the time until `robocas --help` and the help of each command are printed; print JSON, one line per command.

python benchmarks/startup.py --repeats 5

JSON keys:
  command   the command
  wall_s    shortest wall-clock time of all repeats in seconds
  cpu_s     shortest CPU time of all repeats in seconds
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from robocas_ms3.cli.main import COMMANDS

PROGRAM = Path(__file__).resolve().parents[1] / "robocas_cli.py"


@dataclass
class Benchmark:
    repeats: int = 5
    """Runs of each command; the least time counts."""


def measure_seconds(words: list[str]) -> tuple[float, float]:
    """Return wall-clock and CPU seconds of a command."""
    start, before = time.perf_counter(), os.times()
    subprocess.run([sys.executable, str(PROGRAM), *words], stdout=subprocess.DEVNULL, check=True)
    after = os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - start, used


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    for words in ([], *([name] for name in COMMANDS)):
        runs = [measure_seconds([*words, "--help"]) for _ in range(cfg.repeats)]
        wall, cpu = (round(min(times), 3) for times in zip(*runs, strict=True))
        print(json.dumps({"command": " ".join(["robocas", *words, "--help"]), "wall_s": wall, "cpu_s": cpu}))


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
