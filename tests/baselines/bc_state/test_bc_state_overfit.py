"""`bc-state` learns five made-up episodes by heart, from what a simulator would have said to what a policy does."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from robocas_ms3.baselines.bc_state import BASELINE, data
from robocas_ms3.baselines.bc_state.config import BcStateConfig
from robocas_ms3.baselines.bc_state.data import StateSamples
from robocas_ms3.baselines.policy import RunPolicy
from robocas_ms3.baselines.training.session import train_run
from robocas_ms3.core.poses import inverse, to_wxyz
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations

SMALL = {"chunk": 4, "width": 64, "blocks": 2, "dropout": 0.0, "noise": 0.0}
STEPS = 800
TRAIN = {"steps": STEPS, "batch_size": 64, "learning_rate": 5e-3, "warmup_steps": 20, "ema": 0.9}
LENGTH = 16
DOWN = np.diag([1.0, -1.0, -1.0])


def episode(rng):
    """Reach down to a thing in 7 steps, close, carry it to its place in 6, open."""
    home, thing, place = rng.uniform([0.3, -0.2, 0.3], [0.5, 0.2, 0.5], (3, 3))
    thing[2], place[2] = 0.05, 0.25
    share = np.clip(np.arange(LENGTH) / 7, 0, 1)[:, None], np.clip((np.arange(LENGTH) - 8) / 6, 0, 1)[:, None]
    poses = np.tile(np.eye(4), (LENGTH, 1, 1))
    poses[:, :3, :3] = DOWN
    poses[:, :3, 3] = home + share[0] * (thing - home) + share[1] * (place - thing)
    opened = (np.arange(LENGTH) < 8) | (np.arange(LENGTH) >= 15)
    tcp = poses[:, :3, 3]
    told = np.concatenate([np.tile(thing, (LENGTH, 1)), np.tile(place, (LENGTH, 1)), thing - tcp, place - tcp], axis=1)
    return told, poses, opened, np.where(opened, 0.08, 0.04)


@pytest.fixture
def path(tmp_path, monkeypatch):
    """A trajectory of six made-up episodes; one validates."""
    rng = np.random.default_rng(0)
    parts = zip(*(episode(rng) for _ in range(6)), strict=True)
    told = dict(zip(("told", "poses", "opened", "widths"), map(np.concatenate, parts), strict=True))
    told |= {"lengths": np.full(6, LENGTH), "seeds": np.arange(6)}
    monkeypatch.setattr(data, "_told", lambda *_: told)
    (tmp_path / "F.h5").write_text("made up")
    return tmp_path / "F.h5"


def shown(told, pose, width):
    nothing = np.zeros((1, 12), np.float32)
    return Observations(
        envs=np.array([0]),
        instructions=[""],
        embeddings=np.zeros((1, 384), np.float32),
        images={},
        depths={},
        qpos=nothing,
        tcp_in_base=to_wxyz(pose[None]),
        gripper_width=np.array([[width]]),
        state=told[None],
    )


@pytest.fixture
def run(path, tmp_path):
    record = train_run("bc-state", path, tmp_path / "run", {**SMALL, "train": TRAIN}, device="cpu")
    assert record.data.episodes == 5
    return tmp_path / "run"


def test_five_episodes_are_learned(path, run):
    """Chunks to 5 mm, of steps of 50 or so, and 95 % of commands; and so does the policy that comes of it."""
    samples = StateSamples(BcStateConfig(**SMALL), path, "train")
    batch = samples.__getitems__(list(range(len(samples))))
    model = BASELINE.model(BcStateConfig(**SMALL), samples.facts).eval()
    model.load_state_dict(load_file(run / "weights.safetensors"))
    with torch.inference_mode():
        chunk = model.act(batch["told"])
    off = (chunk[..., :3] - batch["chunk"][..., :3]).norm(dim=-1)
    right = (chunk[..., 9] > 0.5) == (batch["chunk"][..., 9] > 0.5)
    assert off.mean() < 0.005
    assert right.float().mean() >= 0.95

    policy = RunPolicy(run, "cpu")
    recorded = data._told(path, 5.0, None)
    shifts, commands = [], []
    for number in split_by_seed(dict(enumerate(range(6))))[0]:
        rows = slice(number * LENGTH, (number + 1) * LENGTH)
        told, poses, opened, widths = (recorded[name][rows] for name in ("told", "poses", "opened", "widths"))
        policy.reset([EpisodeSpec(0, 0, "pick", "", "", "builtin", 0, "")])
        for step in range(LENGTH - 1):
            action = policy.act(shown(told[step], poses[step], widths[step]))[0]
            wanted = (inverse(poses[step]) @ poses[step + 1])[:3, 3]
            shifts.append(np.linalg.norm(action[:3] - wanted))
            commands.append((action[6] > 0.5) == opened[step + 1])
    assert np.mean(shifts) < 0.005
    assert np.mean(commands) >= 0.95
