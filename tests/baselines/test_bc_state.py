"""`bc-state`: reading and caching of states, and refused trajectories."""

import json
from importlib.metadata import version
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from synthetic import write_trajectory
from synthetic_observations import observe, start
from training_runs import fit

from robocas_ms3.baselines import bc_state
from robocas_ms3.baselines.bc_state import BASELINE, BcStateConfig
from robocas_ms3.core.errors import DatasetError, EvaluationError
from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.recordings.environment import RecordedEnv


def read(path, **config):
    return BASELINE.data(BcStateConfig(**config), path, "train", lambda done, total: None)


@pytest.fixture
def simulator(monkeypatch, tmp_path):
    """Replace the simulator by a stub that returns given states in turn (then the last one) and counts its envs."""
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    env, made = SimpleNamespace(reset=lambda **_: None, close=lambda: None, unwrapped=None), []
    monkeypatch.setattr(RecordedEnv, "make", lambda self, **_: made.append(1) or env)

    def simulate(*states):
        rest = list(states)
        state = lambda *_: np.array(rest.pop(0) if len(rest) > 1 else rest[0])  # noqa: E731
        monkeypatch.setattr(bc_state, "_read_privileged_state", state)
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


def change_json(path, change):
    values = json.loads(path.with_suffix(".json").read_text())
    change(values)
    path.with_suffix(".json").write_text(json.dumps(values))


@pytest.mark.parametrize(
    "change",
    [
        lambda values: values["env_info"]["env_kwargs"].update(config="pick_upstream_eval"),
        lambda values: values["episodes"][0]["reset_kwargs"].update(seed=17),
        *("robocas-ms3", "mani_skill", "sapien"),  # another version of these
        *(0, 50, 400),  # remaining bytes of the cache file
    ],
)
def test_states_are_read_again_for_other_data_versions_or_a_damaged_cache(
    simulator, trajectory, tmp_path, monkeypatch, change
):
    made = simulator([1.0])
    read(trajectory)
    [cache] = cached(tmp_path)
    if callable(change):
        change_json(trajectory, change)
    elif isinstance(change, str):
        monkeypatch.setattr(bc_state, "version", lambda name: "99" if name == change else version(name))
    else:
        cache.write_bytes(cache.read_bytes()[:change])
    read(trajectory)
    read(trajectory)
    assert len(made) == 2 and len(cached(tmp_path)) == (1 if isinstance(change, int) else 2)


@pytest.mark.parametrize(
    ("states", "where"),
    [
        ([[1.0, np.nan]], ", state"),
        ([[1.0, 2.0], [np.inf, 2.0], [1.0, 2.0]], ", state"),
        ([*[[1.0, 2.0]] * 7, [1.0, 2.0, 3.0]], ", episode 1"),  # one per sample of the first episode
    ],
)
def test_invalid_states_are_refused(simulator, trajectory, tmp_path, states, where):
    simulator(*states)
    with pytest.raises(DatasetError) as caught:
        read(trajectory)
    assert caught.value.where == f"{trajectory}{where}"
    assert not cached(tmp_path)


def test_files_without_successful_episodes_are_refused(simulator, tmp_path):
    simulator([1.0])
    failed = write_trajectory(tmp_path / "F.h5", seeds=(3,), failed=(0,))
    for path in (failed, tmp_path, tmp_path / "data_info.json"):
        with pytest.raises(DatasetError) as caught:
            read(path)
        assert caught.value.where == path


def test_samples_are_learned_and_the_policy_has_the_same_inputs(simulator, trajectory):
    """The loss falls, and the policy executes the network's prediction for the sample of a step."""
    simulator([1.0, 2.0])
    config = BcStateConfig(width=64, blocks=2, dropout=0, noise=0)
    samples = read(trajectory)
    model, losses = fit(BASELINE, config, samples, 60)
    assert losses[-1] < 0.4 * losses[0]
    arrays = bc_state.load_cached_states(trajectory, config.rate_hz, lambda done, total: None)
    policy = BASELINE.policy(config, samples.facts, model)
    [number] = split_by_seed(dict(enumerate(arrays["seeds"].tolist())))[0]
    for step in (0, 4):
        row = slice(number * len(samples) + step, number * len(samples) + step + 1)
        tcp, width, state = to_wxyz(arrays["poses"][row]), arrays["widths"][row, None], arrays["state"][row]
        policy.reset([start()])
        action = policy.act(observe(tcp_in_base=tcp, gripper_width=width, state=state))[0]
        with torch.inference_mode():
            chunk = model.act(samples.__getitems__([step])["inputs"])[0]
        assert action[:3] == pytest.approx(chunk[0, :3].numpy(), abs=1e-5)
        assert (action[6] > 0.5) == (chunk[0, 9] > 0.5)


def test_other_scenes_are_refused():
    scale = {"mean": [0.0] * 9, "deviation": [1.0] * 9}
    inputs = {"mean": [0.0] * 13, "deviation": [1.0] * 13}
    facts, config = {"rate_hz": 5.0, "inputs": inputs, "chunk": scale, "keys": scale}, BcStateConfig(width=8, blocks=1)
    policy = BASELINE.policy(config, facts, BASELINE.model(config, facts).eval())
    policy.reset([start()])
    with pytest.raises(EvaluationError):
        policy.act(observe(state=np.zeros((1, 5))))
