"""Measure the CPU time of a control step, next to PickCube-v1 of ManiSkill and to physics alone; print JSON.

python benchmarks/step.py [--rounds 5] [--steps 100]

Nothing is rendered. The arms of all cases make the same motion in the air. The cases alternate, so that other programs
affect all cases. JSON keys:
  ms      case -> median over the rounds of the CPU time of this process per control step in ms
  ratio   "case / other case" -> median over the rounds of the ratio of the times
Cases: pick_cube (PickCube-v1), pick and search (RoboCASPick-v1, RoboCASSearch-v1, joint positions, states),
pick_ee (RoboCASPick-v1 with pd_ee_delta_pose), pick_recorded and search_recorded (with the recorder of episodes),
pick_bare and search_bare (only PhysX).
"""

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from mani_skill.envs.tasks import PickCubeEnv  # noqa: F401  (registers it)

import robocas_ms3.tasks  # noqa: F401
from robocas_ms3.demos.recordings.episode_recorder import EpisodeRecorder
from robocas_ms3.robots.description import MOBILE_PANDA

CUBE_REST = (0.0, np.pi / 8, 0.0, -np.pi * 5 / 8, 0.0, np.pi * 3 / 4, np.pi / 4)
AGAINST = {
    "pick": "pick_cube",
    "search": "pick_cube",
    "pick_ee": "pick_cube",
    "pick_recorded": "pick_bare",
    "search_recorded": "search_bare",
}


@dataclass
class Args:
    rounds: int = 5
    """Number of rounds of each case."""
    steps: int = 100
    """Control steps per round, at 20 Hz."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    sway = 0.15 * np.sin(np.arange(args.steps)[:, None] / 20 + np.arange(7))
    joints = np.column_stack([MOBILE_PANDA.arm_rest + sway - sway[0], np.ones(args.steps)]).astype(np.float32)
    cube = np.column_stack([CUBE_REST + sway - sway[0], np.ones(args.steps)]).astype(np.float32)
    deltas = np.column_stack([0.1 * np.diff(sway[:, :6], axis=0, prepend=sway[:1, :6]), np.ones(args.steps)])
    with tempfile.TemporaryDirectory() as folder:
        pick, search = make_env("RoboCASPick-v1", "none"), make_env("RoboCASSearch-v1", "none")
        cases: dict[str, tuple[gym.Env, Callable[[gym.Env, np.ndarray], None], np.ndarray]] = {
            "pick_cube": (make_env("PickCube-v1", "state"), run_steps, cube),
            "pick": (make_env("RoboCASPick-v1", "state"), run_steps, joints),
            "search": (make_env("RoboCASSearch-v1", "state"), run_steps, joints),
            "pick_ee": (make_env("RoboCASPick-v1", "state", "pd_ee_delta_pose"), run_steps, deltas.astype(np.float32)),
            "pick_recorded": (EpisodeRecorder(pick, Path(folder), "pick"), run_steps, joints),
            "search_recorded": (EpisodeRecorder(search, Path(folder), "search"), run_steps, joints),
            "pick_bare": (pick, run_bare_steps, joints),
            "search_bare": (search, run_bare_steps, joints),
        }
        taken: dict[str, list[float]] = {name: [] for name in cases}
        for _ in range(args.rounds):
            for name, (env, play, actions) in cases.items():
                env.reset(seed=0)
                start = time.process_time()
                play(env, actions)
                taken[name].append(1000 * (time.process_time() - start) / args.steps)
    ratios = {
        f"{name} / {base}": round(float(np.median(np.divide(taken[name], taken[base]))), 2)
        for name, base in AGAINST.items()
    }
    print(json.dumps({"ms": {n: round(float(np.median(t)), 3) for n, t in taken.items()}, "ratio": ratios}, indent=2))


def make_env(env_id: str, obs_mode: str, control_mode: str = "pd_joint_pos") -> gym.Env:
    return gym.make(env_id, obs_mode=obs_mode, control_mode=control_mode, render_backend="none")


def run_steps(env: gym.Env, actions: np.ndarray) -> None:
    for action in actions:
        env.step(action)


def run_bare_steps(env: gym.Env, actions: np.ndarray) -> None:
    """Step only PhysX with ``pd_joint_pos`` actions."""
    base: Any = env.unwrapped
    system, joints = base.scene.px, base.agent.robot.joints_map
    drives = [joints[name]._objs[0] for name in (*MOBILE_PANDA.arm_joints, *MOBILE_PANDA.finger_joints)]
    low, high = MOBILE_PANDA.finger_targets
    last = np.array([drive.drive_target[0] for drive in drives])
    for action in actions.astype(float):
        finger = low + (action[7] + 1) / 2 * (high - low)
        target = np.array([*action[:7], finger, finger])
        count = base.sim_freq // base.control_freq
        for targets in np.linspace(last, target, count + 1)[1:].tolist():
            for drive, value in zip(drives, targets, strict=True):
                drive.set_drive_target(value)
            system.step()
        last = target


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
