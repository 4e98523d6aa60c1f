"""Steps a second of several environments in processes, beside one plain environment, states only; prints JSON.

Random actions; resets are not timed. The cases take turns. Environments that step together all wait for one that is
held up, so a turn begins when the machine is quiet, and counts if nothing else took more than ``--others`` of its CPU
time meanwhile. Figures are medians over turns; CPU time is that of this process and of the case's workers.

Run: python benchmarks/vector.py [--turns 7] [--steps 100]
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

CASES = {"1 env": (1, 1), "2 envs": (2, 2), "4 envs": (4, 2), "4 envs, 1 process": (4, 1)}  # envs, processes
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
    turns: int = 7
    """That count, of each case."""
    steps: int = 100
    """Of each env a turn."""
    others: float = 0.05
    """Share of the machine's CPU time that a quiet machine may spend elsewhere."""
    minutes: float = 10
    """After which it ends, with fewer turns than asked for."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    kwargs = {name: getattr(args, name) for name in ("obs_mode", "control_mode", "render_backend")}
    envs: dict[str, Any] = {"plain gym.make": gym.make(args.env_id, **kwargs)}
    for name, (count, processes) in CASES.items():
        envs[name] = robocas_ms3.make_vec(args.env_id, count, backend="processes", workers=processes, **kwargs)
    kept: dict[str, list[tuple[float, float]]] = {name: [] for name in envs}
    dropped, until = 0, time.monotonic() + 60 * args.minutes
    while min(map(len, kept.values())) < args.turns and time.monotonic() < until:
        for name in sorted(envs, key=lambda name: len(kept[name])):
            wait_for_quiet(args.others, until)
            wall, cpu, others = turn(envs[name], args.steps)
            if others <= args.others:
                kept[name].append((wall, cpu))
            else:
                dropped += 1
    if not all(kept.values()):
        raise SystemExit(f"the machine was never quiet enough: {dropped} turns dropped")
    report: dict[str, dict[str, float]] = {}
    for name, env in envs.items():
        steps = args.steps * CASES.get(name, (1, 1))[0]
        wall, cpu = np.median(kept[name], axis=0) / steps
        report[name] = {
            "steps_a_second": round(1 / wall),
            "cpu_ms_a_step": round(1000 * cpu, 2),
            "turns": len(kept[name]),
        }
        env.close()
    rate = {name: figures["steps_a_second"] for name, figures in report.items()}
    ratios = {f"{name} / plain": round(rate[name] / rate["plain gym.make"], 2) for name in CASES}
    ratios["2 processes / 1, 4 envs"] = round(rate["4 envs"] / rate["4 envs, 1 process"], 2)
    ratios["2 envs / 1 env"] = round(rate["2 envs"] / rate["1 env"], 2)
    print(json.dumps({"cores": CORES, **vars(args), "dropped": dropped, "cases": report, "ratio": ratios}, indent=2))


def turn(env: Any, steps: int) -> tuple[float, float, float]:
    """Seconds, CPU seconds, and the share of the machine's CPU time that others took meanwhile."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    begun, spent, used = time.perf_counter(), cpu_seconds(env), machine_seconds()
    for action in actions:
        env.step(action)
    wall, cpu = time.perf_counter() - begun, cpu_seconds(env) - spent
    return wall, cpu, (machine_seconds() - used - cpu) / (wall * CORES)


def wait_for_quiet(others: float, until: float) -> None:
    """Wait until this machine does nothing, for 0.3 s."""
    while time.monotonic() < until:
        used = machine_seconds()
        time.sleep(0.3)
        if machine_seconds() - used <= others * 0.3 * CORES:
            return


def cpu_seconds(env: Any) -> float:
    """What this process has used, and the processes of an environment."""
    spent = time.process_time()
    if isinstance(env.unwrapped, ProcessEnv):
        for pid in env.unwrapped.pids:
            user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
            spent += (int(user) + int(system)) / TICKS
    return spent


def machine_seconds() -> float:
    """CPU time of all that ran on this machine."""
    user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + irq + soft + steal) / TICKS


if __name__ == "__main__":
    main(tyro.cli(Args))
