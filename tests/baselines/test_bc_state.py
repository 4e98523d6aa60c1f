"""`bc-state`: what it reads from a trajectory and caches, what it refuses, and that it learns made-up episodes."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_up_observations import observe, start
from made_up_runs import train
from safetensors.torch import load_file
from synthetic import write_trajectory

from robocas_ms3.baselines import bc_state
from robocas_ms3.baselines.bc_state import BASELINE, BcStateConfig
from robocas_ms3.baselines.policy import RunPolicy
from robocas_ms3.core.errors import DatasetError, EvaluationError
from robocas_ms3.core.poses import inverse, to_wxyz
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.recordings.environment import RecordedEnv

LENGTH = 16


def read(path, **config):
    return BASELINE.data(BcStateConfig(**config), path, "train", lambda done, total: None)


@pytest.fixture
def simulator(monkeypatch, tmp_path):
    """Replaces the simulator by one with given states, one after the other, the last for good; counts its envs."""
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    env, made = SimpleNamespace(reset=lambda **_: None, close=lambda: None, unwrapped=None), []
    monkeypatch.setattr(RecordedEnv, "make", lambda self, **_: made.append(1) or env)

    def simulate(*states):
        rest = list(states)
        state = lambda *_: np.array(rest.pop(0) if len(rest) > 1 else rest[0])  # noqa: E731
        monkeypatch.setattr(bc_state, "_privileged_state", state)
        return made

    return simulate


@pytest.fixture
def trajectory(tmp_path):
    return write_trajectory(tmp_path / "F.h5", seeds=(3, 4))


def cached(tmp_path):
    return list((tmp_path / "cache" / "bc-state").glob("*"))


def test_states_are_read_once(simulator, trajectory, tmp_path):
    made = simulator([1.0, 2.0, 3.0])
    first, again = read(trajectory), read(trajectory, chunk=4)
    assert first.episodes == 1 and len(first.facts["inputs"]["mean"]) == 3 + 10
    assert len(made) == len(cached(tmp_path)) == 1
    every = list(range(len(first)))
    assert torch.equal(first.__getitems__(every)["inputs"], again.__getitems__(every)["inputs"])
    read(trajectory, rate_hz=10)
    assert len(made) == 2


@pytest.mark.parametrize(
    "change",
    [
        lambda values: values["env_info"]["env_kwargs"].update(config="pick_upstream_eval"),
        lambda values: values["episodes"][0]["reset_kwargs"].update(seed=17),
    ],
)
def test_another_json_is_read_again(simulator, trajectory, change):
    made = simulator([1.0])
    read(trajectory)
    path = trajectory.with_suffix(".json")
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    read(trajectory)
    assert len(made) == 2


@pytest.mark.parametrize("package", ["robocas-ms3", "mani_skill", "sapien"])
def test_another_version_reads_again(simulator, trajectory, monkeypatch, package):
    made = simulator([1.0])
    read(trajectory)
    now = {**bc_state.versions(), package: "99"}
    monkeypatch.setattr(bc_state, "versions", lambda: now)
    read(trajectory)
    assert len(made) == 2


@pytest.mark.parametrize("keep", [0, 50, 400])
def test_a_damaged_cache_is_written_again(simulator, trajectory, tmp_path, keep):
    made = simulator([1.0])
    read(trajectory)
    [path] = cached(tmp_path)
    path.write_bytes(path.read_bytes()[:keep])
    read(trajectory)
    read(trajectory)
    assert len(made) == 2 and cached(tmp_path) == [path]


@pytest.mark.parametrize(
    ("states", "where"),
    [
        ([[1.0, np.nan]], ", state"),
        ([[1.0, 2.0], [np.inf, 2.0], [1.0, 2.0]], ", state"),
        ([*[[1.0, 2.0]] * 7, [1.0, 2.0, 3.0]], ", episode 1"),  # as many as are sampled of the first episode
    ],
)
def test_states_that_can_not_be_learned_from(simulator, trajectory, tmp_path, states, where):
    simulator(*states)
    with pytest.raises(DatasetError) as caught:
        read(trajectory)
    assert caught.value.where == f"{trajectory}{where}"
    assert not cached(tmp_path)


def test_what_is_no_trajectory_with_successes(simulator, tmp_path):
    simulator([1.0])
    failed = write_trajectory(tmp_path / "F.h5", seeds=(3,), failed=(0,))
    for path in (failed, tmp_path, tmp_path / "data_info.json"):
        with pytest.raises(DatasetError) as caught:
            read(path)
        assert caught.value.where == path


def test_other_scenes_are_refused():
    scale = {"mean": [0.0] * 9, "deviation": [1.0] * 9}
    inputs = {"mean": [0.0] * 13, "deviation": [1.0] * 13}
    facts, config = {"rate_hz": 5.0, "inputs": inputs, "chunk": scale, "keys": scale}, BcStateConfig(width=8, blocks=1)
    policy = BASELINE.policy(config, facts, BASELINE.model(config, facts).eval())
    policy.reset([start()])
    with pytest.raises(EvaluationError):
        policy.act(observe(state=np.zeros((1, 5))))


SMALL = {"chunk": 4, "width": 64, "blocks": 2, "dropout": 0.0, "noise": 0.0}
TRAIN = {"steps": 800, "batch_size": 64, "learning_rate": 5e-3, "warmup_steps": 20, "ema": 0.9}


def episode(rng):
    """Reach down to an object in 7 steps, close, carry it to its place in 6, open."""
    home, thing, place = rng.uniform([0.3, -0.2, 0.3], [0.5, 0.2, 0.5], (3, 3))
    thing[2], place[2] = 0.05, 0.25
    share = np.clip(np.arange(LENGTH) / 7, 0, 1)[:, None], np.clip((np.arange(LENGTH) - 8) / 6, 0, 1)[:, None]
    poses = np.tile(np.eye(4), (LENGTH, 1, 1))
    poses[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    poses[:, :3, 3] = home + share[0] * (thing - home) + share[1] * (place - thing)
    opened = (np.arange(LENGTH) < 8) | (np.arange(LENGTH) >= 15)
    tcp = poses[:, :3, 3]
    state = np.concatenate([np.tile(thing, (LENGTH, 1)), np.tile(place, (LENGTH, 1)), thing - tcp, place - tcp], axis=1)
    return state, poses, opened, np.where(opened, 0.08, 0.04)


def test_five_episodes_are_learned(tmp_path, monkeypatch):
    """Chunks to 5 mm, of steps of about 50 mm, and 95 % of commands; by the network and by the policy of the run."""
    rng = np.random.default_rng(0)
    parts = zip(*(episode(rng) for _ in range(6)), strict=True)
    arrays = dict(zip(("state", "poses", "opened", "widths"), map(np.concatenate, parts), strict=True))
    arrays |= {"lengths": np.full(6, LENGTH), "seeds": np.arange(6)}
    monkeypatch.setattr(bc_state, "load_states", lambda *_: arrays)
    path, run = tmp_path / "F.h5", tmp_path / "run"
    path.write_text("made up")
    assert train("bc-state", path, run, {**SMALL, "train": TRAIN}).data.episodes == 5
    samples = read(path, **SMALL)
    batch = samples.__getitems__(list(range(len(samples))))
    model = BASELINE.model(BcStateConfig(**SMALL), samples.facts).eval()
    model.load_state_dict(load_file(run / "weights.safetensors"))
    with torch.inference_mode():
        chunk = model.act(batch["inputs"])
    assert (chunk[..., :3] - batch["chunk"][..., :3]).norm(dim=-1).mean() < 0.005
    assert ((chunk[..., 9] > 0.5) == (batch["chunk"][..., 9] > 0.5)).float().mean() >= 0.95

    policy = RunPolicy(run, "cpu")
    shifts, commands = [], []
    for number in split_by_seed(dict(enumerate(range(6))))[0]:
        rows = slice(number * LENGTH, (number + 1) * LENGTH)
        state, poses, opened, widths = (arrays[name][rows] for name in ("state", "poses", "opened", "widths"))
        policy.reset([start()])
        for step in range(LENGTH - 1):
            tcp, width = to_wxyz(poses[step][None]), np.array([[widths[step]]])
            action = policy.act(observe(tcp_in_base=tcp, gripper_width=width, state=state[step][None]))[0]
            wanted = (inverse(poses[step]) @ poses[step + 1])[:3, 3]
            shifts.append(np.linalg.norm(action[:3] - wanted))
            commands.append((action[6] > 0.5) == opened[step + 1])
    assert np.mean(shifts) < 0.005
    assert np.mean(commands) >= 0.95
