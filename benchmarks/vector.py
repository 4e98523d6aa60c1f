"""Steps a second of several environments in processes, beside one plain environment, states only; prints JSON.

Random actions; resets are not timed. The cases take turns. Environments that step together all wait for one that is
held up, so steps a second are the median over turns in which nothing else took more than ``--others`` of the
machine's CPU time, null without one. CPU time counts in every turn: of this process, of the busiest worker and of all
together. A step takes at least what this process and then the busiest worker need, which is what free cores would give.

Run: python benchmarks/vector.py [--turns 5] [--steps 100]
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro

import robocas_ms3
from robocas_ms3.tasks.vector.processes import ProcessEnv

CASES = {  # envs, processes
    "1 env": (1, 1),
    "2 envs": (2, 2),
    **{f"{n} envs": (n, 2) for n in (4, 8, 16)},
    **{f"{n} envs, 1 process": (n, 1) for n in (4, 8, 16)},
}
COMPARED = [
    *((name, "plain gym.make") for name in CASES),
    *((f"{n} envs", f"{n} envs, 1 process") for n in (4, 8, 16)),
    ("2 envs", "1 env"),
]
CPU = ("this process", "busiest worker", "together")
CORES, TICKS = os.cpu_count() or 1, os.sysconf("SC_CLK_TCK")


@dataclass
class Args:
    env_id: str = "RoboCASPick-v1"
    """Environment."""
    control_mode: str = "pd_joint_delta_pos"
    """Of the actions."""
    obs_mode: str = "state"
    """Observations; with pictures drop --render-backend none."""
    render_backend: str = "none"
    """None needs no renderer."""
    turns: int = 5
    """That count, of each case."""
    steps: int = 100
    """Of each env a turn."""
    others: float = 0.05
    """Share of the machine's CPU time that a quiet machine may spend elsewhere."""
    minutes: float = 8
    """After which it ends, with fewer turns than asked for."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    kwargs = {name: getattr(args, name) for name in ("obs_mode", "control_mode", "render_backend")}
    envs: dict[str, Any] = {"plain gym.make": gym.make(args.env_id, **kwargs)}
    for name, (count, processes) in CASES.items():
        envs[name] = robocas_ms3.make_vec(args.env_id, count, backend="processes", workers=processes, **kwargs)
    quiet: dict[str, list[float]] = {name: [] for name in envs}
    spent: dict[str, list[tuple[float, float, float]]] = {name: [] for name in envs}
    until = time.monotonic() + 60 * args.minutes
    while min(map(len, quiet.values())) < args.turns and time.monotonic() < until:
        for name in sorted(envs, key=lambda name: len(quiet[name])):
            wait_for_quiet(args.others)
            wall, cpu, others = turn(envs[name], args.steps)
            spent[name].append(cpu)
            quiet[name] += [wall] if others <= args.others else []
    report: dict[str, dict[str, Any]] = {}
    for name, env in envs.items():
        count = CASES.get(name, (1, 1))[0]
        own, busiest, all_ = 1000 * np.median(spent[name], axis=0) / args.steps
        report[name] = {
            "steps_a_second": round(count * args.steps / float(np.median(quiet[name]))) if quiet[name] else None,
            "quiet_turns": f"{len(quiet[name])} of {len(spent[name])}",
            "cpu_ms_a_step_of_all": dict(zip(CPU, [round(float(ms), 2) for ms in (own, busiest, all_)], strict=True)),
            "on_free_cores": round(1000 * count / (own + busiest)),
        }
        env.close()
    kinds = ("steps_a_second", "on_free_cores")
    ratios = {f"{one} / {other}": {kind: ratio(report, one, other, kind) for kind in kinds} for one, other in COMPARED}
    print(json.dumps({"cores": CORES, **vars(args), "cases": report, "ratio": ratios}, indent=2))


def ratio(report: dict[str, dict[str, Any]], one: str, other: str, key: str) -> float | None:
    if report[one][key] is None or report[other][key] is None:
        return None
    return round(report[one][key] / report[other][key], 2)


def turn(env: Any, steps: int) -> tuple[float, tuple[float, float, float], float]:
    """Seconds, CPU seconds (this process, busiest worker, together), share of the machine's that went elsewhere."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    pids = env.unwrapped.pids if isinstance(env.unwrapped, ProcessEnv) else []
    begun, own, before, used = time.perf_counter(), time.process_time(), [*map(cpu_of, pids)], machine_seconds()
    for action in actions:
        env.step(action)
    wall, own = time.perf_counter() - begun, time.process_time() - own
    workers = [cpu_of(pid) - earlier for pid, earlier in zip(pids, before, strict=True)]
    together = own + sum(workers)
    return wall, (own, max(workers, default=0.0), together), (machine_seconds() - used - together) / (wall * CORES)


def wait_for_quiet(others: float, patience: float = 3.0) -> None:
    """Wait until this machine does nothing, for 0.3 s; not for ever."""
    until = time.monotonic() + patience
    while time.monotonic() < until:
        used = machine_seconds()
        time.sleep(0.3)
        if machine_seconds() - used <= others * 0.3 * CORES:
            return


def cpu_of(pid: int) -> float:
    """Seconds of CPU time that a process has used."""
    nanoseconds = Path(f"/proc/{pid}/schedstat").read_text().split()[0]
    return int(nanoseconds) / 1e9


def machine_seconds() -> float:
    """CPU time of all that ran on this machine."""
    user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + irq + soft + steal) / TICKS


if __name__ == "__main__":
    main(tyro.cli(Args))
