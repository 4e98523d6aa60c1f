"""Measure the CPU time of the evaluation loop and of a bare loop over equal scenes and actions; print JSON.

python benchmarks/evaluation.py [--tasks pick search] [--turns 5] [--steps 300]

The bare loop only resets and steps the same vector environment, without policy, stages, measures and files. Both loops
run one episode in each env with equal joint targets and an equal number of steps; resets are not timed. The loops
alternate. CPU time is the sum over this process and the worker processes. JSON keys:
  cores, tasks, protocol, envs, turns, steps   number of cores, and options of the benchmark
  cases                                        per task:
    bare, cpu ms per step; evaluation, cpu ms per step   median over the rounds of the CPU time per step and env in ms
    evaluation / bare                                    ratio of these times
    turns                                                CPU seconds of each round
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

import robocas_ms3
from robocas_ms3.evaluation import (
    EpisodeSpec,
    EvaluationSession,
    EvaluationSettings,
    Observations,
    PolicySpec,
    load_protocol,
)
from robocas_ms3.evaluation.protocols.protocol import ProtocolEpisode
from robocas_ms3.evaluation.rollouts.rollout import run_rollouts
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.scenes.task_specs import TASKS

RATE = 20  # Hz
REACH = 0.3  # rad, amplitude of the joint motion


@dataclass
class Args:
    tasks: tuple[str, ...] = ("pick", "search")
    """Tasks of the protocol."""
    protocol: str = "ms3-v1"
    """Protocol with the scenes."""
    envs: int = 2
    """Number of envs."""
    turns: int = 5
    """Number of rounds of each case."""
    steps: int = 300
    """Steps of each env per round."""


class JointWavePolicy:
    """Policy that moves the joints back and forth about their initial positions, with an open gripper."""

    spec = PolicySpec("joint_positions", rate_hz=RATE, language="none")

    def __init__(self) -> None:
        self._step, self._from = 0, np.zeros((0, 7))

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start episodes in all envs."""
        self._step = 0

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return joint targets (E, 8)."""
        return self.next_targets(observations.qpos)

    def next_targets(self, qpos: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the next targets from the joint positions at the first step."""
        if self._step == 0:
            self._from = np.array(qpos[:, MOBILE_PANDA.arm_slice])
        self._step += 1
        away = REACH * np.sin(self._step / RATE) * np.array([1, 0.5, 1, 0.5, 1, 1, 1])
        return np.concatenate([self._from + away, np.ones((len(self._from), 1))], axis=1).astype(np.float32)


def main(args: Args) -> None:
    torch.set_num_threads(1)
    protocol, cases = load_protocol(args.protocol), {}
    for task in args.tasks:
        episodes = [one for one in protocol.episodes if one.task == task][: args.envs]
        bare = robocas_ms3.make_vec(
            TASKS[task].env_id,
            args.envs,
            arrays="numpy",
            auto_reset=False,
            ignore_terminations=True,
            record_metrics=False,
            backend="processes",
            config=str(protocol.config_file(episodes[0].config)),
            layouts=str(protocol.layouts_file(episodes[0].config)),
            control_mode="pd_joint_pos",
            obs_mode="state_dict",
            reward_mode="none",
            render_backend="none",
            sim_config={"control_freq": RATE},
            max_episode_steps=10**9,
        )
        settings = EvaluationSettings(protocol=args.protocol, envs=args.envs, backend="processes")
        ours = EvaluationSession(JointWavePolicy(), settings)
        spent: dict[str, list[float]] = {"bare": [], "evaluation": []}
        for _ in range(args.turns):
            spent["bare"].append(run_bare_loop(bare, [one.seed for one in episodes], args.steps))
            spent["evaluation"].append(run_evaluation_loop(ours, episodes, args.steps))
        per_step = {name: 1000 * float(np.median(turns)) / args.steps / args.envs for name, turns in spent.items()}
        cases[task] = {
            **{f"{name}, cpu ms per step": round(value, 3) for name, value in per_step.items()},
            "evaluation / bare": round(per_step["evaluation"] / per_step["bare"], 3),
            "turns": {name: [round(turn, 2) for turn in turns] for name, turns in spent.items()},
        }
        bare.close()
        ours.close()
    print(json.dumps({"cores": os.cpu_count(), **vars(args), "cases": cases}, indent=2))


def run_bare_loop(env: Any, seeds: list[int], steps: int) -> float:
    """Return the CPU seconds of a bare loop."""
    policy = JointWavePolicy()
    policy.reset([])
    obs, _ = env.reset(seed=seeds, options={"env_idx": np.arange(len(seeds))})
    before = read_cpu_seconds(env)
    for _ in range(steps):
        obs, *_ = env.step(policy.next_targets(obs["agent"]["qpos"]))
    return read_cpu_seconds(env) - before


def run_evaluation_loop(session: EvaluationSession, episodes: list[ProtocolEpisode], steps: int) -> float:
    """Return the CPU seconds of the evaluation loop from the first step on."""
    batch = session.open_batch(episodes[0], len(episodes), steps)
    policy = TimedPolicy(batch.env)
    ended = list(run_rollouts(batch, policy, [session.make_episode_spec(one) for one in episodes]))
    assert [one.steps for one in ended] == [steps] * len(episodes)
    return read_cpu_seconds(batch.env) - policy.before


class TimedPolicy(JointWavePolicy):
    """Policy that records the CPU time at the first step."""

    def __init__(self, env: Any) -> None:
        super().__init__()
        self.before, self._env = 0.0, env

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start episodes in all envs."""
        super().reset(episodes)
        self.before = read_cpu_seconds(self._env)


def read_cpu_seconds(env: Any) -> float:
    """Return the CPU seconds of this process and the workers of an environment."""
    workers = [int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9 for pid in env.unwrapped.pids]
    return time.process_time() + sum(workers)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
