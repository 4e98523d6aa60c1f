"""Measure steps per second and memory of several environments on a CPU, without images; print JSON.

python benchmarks/vector.py [--turns 5] [--steps 100] [--envs 8]

The cases are `make_vec`, one plain environment, and gymnasium's ``AsyncVectorEnv`` with ManiSkill's ``CPUGymWrapper``.
Actions are random; resets are not timed. The cases alternate, so that other programs affect all cases. JSON keys:
  env_id ... memory_of    options of the benchmark
  cases                   per case:
    steps_per_second           steps per second of all envs: median over the rounds, by wall-clock time
    on_two_cores               steps per second that two cores of an idle machine would reach, from CPU times: this
                               process and then the workers, distributed over two cores
    cpu_ms_per_step_of_all     CPU time of one step of all envs in ms: of this process, and of all workers
    pss_mb                     memory (PSS) of the workers and growth of this process in MB, while only this case runs
"""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import torch
import tyro

import robocas_ms3

CORES = 2
ASYNC = "AsyncVectorEnv"


@dataclass
class Args:
    env_id: str = "RoboCASPick-v1"
    """Environment."""
    control_mode: str = "pd_joint_delta_pos"
    """Control mode of the actions."""
    obs_mode: str = "state"
    """Observation mode; for images, leave out --render-backend none."""
    render_backend: str = "none"
    """Render backend; `none` needs no renderer."""
    turns: int = 5
    """Number of rounds of each case."""
    steps: int = 100
    """Steps of each env per round."""
    envs: tuple[int, ...] = (8,)
    """Numbers of environments."""
    memory_of: str = ""
    """Only print the memory of this case; used by the benchmark itself."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    cases = make_cases(args)
    if args.memory_of:
        print(measure_memory(cases[args.memory_of]))
        return
    envs = {name: make() for name, make in cases.items()}
    workers = {name: find_worker_pids(env) for name, env in envs.items()}
    taken: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in envs}
    for _ in range(args.turns):
        for name, env in envs.items():
            taken[name].append(run_round(env, workers[name], args.steps))
    report = {}
    for name, env in envs.items():
        count = getattr(env, "num_envs", 1)
        wall, own, busiest, together = np.median(taken[name], axis=0) / args.steps
        report[name] = {
            "steps_per_second": round(count / wall),
            "on_two_cores": round(count / (own + max(busiest, together / CORES))),
            "cpu_ms_per_step_of_all": {"this process": round(1000 * own, 2), "workers": round(1000 * together, 2)},
        }
        env.close()
    for name, case in report.items():
        command = [sys.executable, __file__, "--memory-of", name, "--envs", *map(str, args.envs)]
        case["pss_mb"] = round(float(subprocess.run(command, capture_output=True, check=True, text=True).stdout))
    print(json.dumps({**vars(args), "cases": report}, indent=2))


def make_cases(args: Args) -> dict[str, Callable[[], Any]]:
    kwargs = {name: getattr(args, name) for name in ("obs_mode", "control_mode", "render_backend")}
    cases: dict[str, Callable[[], Any]] = {"gym.make": partial(gym.make, args.env_id, **kwargs)}
    for n in args.envs:
        for processes in (1, 2):
            make = partial(robocas_ms3.make_vec, args.env_id, n, backend="processes", workers=processes, **kwargs)
            cases[f"{n} envs, {processes} processes"] = make
        cases[f"{n} envs, {ASYNC}"] = partial(make_async, args.env_id, n, kwargs)
    return cases


def make_async(env_id: str, count: int, kwargs: dict[str, Any]) -> gym.vector.AsyncVectorEnv:
    multiprocessing.set_forkserver_preload(["robocas_ms3.tasks"])  # so that the processes share imported modules
    makes = [partial(make_unbatched, env_id, kwargs)] * count
    return gym.vector.AsyncVectorEnv(makes, context="forkserver", autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)


def make_unbatched(env_id: str, kwargs: dict[str, Any]) -> gym.Env:
    from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

    torch.set_num_threads(1)
    return CPUGymWrapper(gym.make(env_id, **kwargs))


def find_worker_pids(env: Any) -> list[int]:
    """Return the process ids of a vector environment."""
    if isinstance(env, gym.vector.AsyncVectorEnv):
        return [process.pid for process in env.processes if process.pid is not None]
    return getattr(env.unwrapped, "pids", [])


def run_round(env: Any, workers: Sequence[int], steps: int) -> tuple[float, float, float, float]:
    """Return seconds, and CPU seconds of this process, of the busiest worker and of all workers."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    start, own, before = time.perf_counter(), time.process_time(), [*map(read_cpu_seconds, workers)]
    for action in actions:
        env.step(action)
    wall, own = time.perf_counter() - start, time.process_time() - own
    spent = [read_cpu_seconds(pid) - earlier for pid, earlier in zip(workers, before, strict=True)]
    return wall, own, max(spent, default=0.0), sum(spent)


def read_cpu_seconds(pid: int) -> float:
    """Return the CPU seconds that a process has used."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9


def measure_memory(make: Callable[[], Any]) -> float:
    """Return the memory of a case in MB (PSS): all child processes and the growth of this process."""
    me = psutil.Process()
    before = me.memory_full_info().pss
    env = make()
    run_round(env, [], 20)
    grown = me.memory_full_info().pss - before
    found = grown + sum(child.memory_full_info().pss for child in me.children(recursive=True))
    env.close()
    return found / 2**20


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
