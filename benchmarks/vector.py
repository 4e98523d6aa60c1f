"""Steps a second of several environments in processes, beside one plain environment, states only; prints JSON.

Random actions. The cases take turns, so that what else the machine does meets them all; figures are medians over the
rounds, CPU time is that of this process and of the case's workers. Resets are not timed. ``others`` is the share of the
machine's CPU time that went elsewhere meanwhile: envs in step with each other all wait for one that is held up.

Run: python benchmarks/vector.py [--rounds 5] [--steps 200]
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
    rounds: int = 5
    """How often every case has its turn."""
    steps: int = 200
    """Of each env a turn."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    kwargs = {name: getattr(args, name) for name in ("obs_mode", "control_mode", "render_backend")}
    envs: dict[str, Any] = {"plain gym.make": gym.make(args.env_id, **kwargs)}
    for name, (count, processes) in CASES.items():
        envs[name] = robocas_ms3.make_vec(args.env_id, count, backend="processes", workers=processes, **kwargs)
    wall: dict[str, list[float]] = {name: [] for name in envs}
    cpu: dict[str, list[float]] = {name: [] for name in envs}
    others: dict[str, list[float]] = {name: [] for name in envs}
    for _ in range(args.rounds):
        for name, env in envs.items():
            env.reset(seed=0)
            env.action_space.seed(0)
            actions = [env.action_space.sample() for _ in range(args.steps)]
            begun, spent, used = time.perf_counter(), cpu_seconds(env), machine_seconds()
            for action in actions:
                env.step(action)
            wall[name].append(time.perf_counter() - begun)
            cpu[name].append(cpu_seconds(env) - spent)
            others[name].append(max(0.0, machine_seconds() - used - cpu[name][-1]) / wall[name][-1] / CORES)
    report = {}
    for name, env in envs.items():
        steps = args.steps * CASES.get(name, (1, 1))[0]
        report[name] = {
            "steps_a_second": round(steps / float(np.median(wall[name]))),
            "cpu_ms_a_step": round(1000 * float(np.median(cpu[name])) / steps, 2),
            "others": round(float(np.median(others[name])), 2),
        }
        env.close()
    rate = {name: figures["steps_a_second"] for name, figures in report.items()}
    ratios = {f"{name} / plain": round(rate[name] / rate["plain gym.make"], 2) for name in CASES}
    ratios["2 processes / 1, 4 envs"] = round(rate["4 envs"] / rate["4 envs, 1 process"], 2)
    print(json.dumps({"cores": CORES, **vars(args), "cases": report, "ratio": ratios}, indent=2))


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
