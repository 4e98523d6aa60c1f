"""Demonstrations recorded in single envs on the CPU succeed in a batch on the emulated GPU interface."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gpu_emulation import emulated_envs
from gpu_emulation.physics import EmulatedGpuSystem

from robocas_ms3.demos.recordings.trajectory_file import Recording, TrajectoryFile
from robocas_ms3.tasks import TASKS

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.emulated_gpu_full,
    pytest.mark.skipif(emulated_envs() == 0, reason="a GPU's physics differs from that of a CPU"),
]


@pytest.fixture(scope="module", params=sorted(TASKS))
def recordings(request, tmp_path_factory) -> tuple[str, list[Recording]]:
    """Return a task, and one demonstration per env."""
    folder = tmp_path_factory.mktemp(request.param) / "demos"
    command = [sys.executable, ROOT / "robocas_cli.py", "generate", request.param, "-n", str(emulated_envs())]
    subprocess.run([*command, "--out", folder, "--jobs", "2", "--check-rate", "0"], check=True, cwd=ROOT)
    with TrajectoryFile(folder / "trajectory.h5") as file:
        return request.param, [file.read_recording(i) for i in range(len(file.episodes))]


def test_whole_demonstrations_succeed_in_a_batch(recordings, monkeypatch):
    # this step decides the order in which PhysX solves contacts; single envs on a CPU do not make it
    monkeypatch.setattr(EmulatedGpuSystem, "steps_on_init", False)
    task, episodes = recordings
    seeds = [episode.seed for episode in episodes]
    env = gym.make(
        TASKS[task].env_id,
        num_envs=len(seeds),
        seeds=(min(seeds), max(seeds)),
        obs_mode="none",
        control_mode=episodes[0].control_mode,
        render_backend="none",
    )
    base: Any = env.unwrapped  # without gymnasium's time limit
    base.reset(seed=seeds, options={"reconfigure": True})
    steps = max(len(episode.actions) for episode in episodes)
    actions = np.stack([_held(episode.actions, steps) for episode in episodes], axis=1)
    successes = torch.stack([base.step(action)[4]["success"] for action in torch.from_numpy(actions).to(base.device)])
    first = torch.where(successes.any(0), successes.int().argmax(0), steps).tolist()
    env.close()
    recorded = [len(episode.actions) - 1 for episode in episodes]
    assert len(recorded) == emulated_envs()
    assert all(found <= wanted for found, wanted in zip(first, recorded, strict=True)), (first, recorded)


def _held(actions: np.ndarray, steps: int) -> np.ndarray:
    """Return actions (T, A), padded by the last one to (steps, A)."""
    return np.concatenate([actions, np.repeat(actions[-1:], steps - len(actions), axis=0)])
