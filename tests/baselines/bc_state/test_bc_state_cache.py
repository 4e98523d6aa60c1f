"""What `bc-state` keeps of a trajectory, so that no simulator is asked twice, and when it is asked again."""

import json

import numpy as np
import pytest
from synthetic import write_trajectory

from robocas_ms3.baselines.bc_state import data
from robocas_ms3.baselines.bc_state.config import BcStateConfig
from robocas_ms3.baselines.bc_state.data import StateSamples

LENGTHS = [6, 7]


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """How often a simulator was asked."""
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    calls = []

    def ask(path, rate_hz, on_read):
        calls.append(path)
        count = sum(LENGTHS)
        told, widths = np.arange(count * 3.0).reshape(count, 3), np.full(count, 0.08)
        poses, opened = np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool)
        made = {"told": told, "poses": poses, "opened": opened, "widths": widths}
        return {**made, "lengths": np.array(LENGTHS), "seeds": np.array([3, 4])}

    monkeypatch.setattr(data, "_ask", ask)
    return calls


@pytest.fixture
def trajectory(tmp_path):
    return write_trajectory(tmp_path / "F.h5", seeds=(3, 4))


def read(trajectory, **config):
    return StateSamples(BcStateConfig(**config), trajectory, "train")


def kept(tmp_path):
    return sorted((tmp_path / "cache" / "bc-state").iterdir())


def test_once_is_enough(asked, trajectory, tmp_path):
    first, again = read(trajectory), read(trajectory, chunk=8)
    assert len(asked) == len(kept(tmp_path)) == 1
    assert len(first) == len(again) and (first._told == again._told).all()


def test_another_rate(asked, trajectory):
    read(trajectory)
    read(trajectory, rate_hz=10)
    assert len(asked) == 2


@pytest.mark.parametrize(
    "change",
    [
        lambda said: said["env_info"]["env_kwargs"].update(config="pick_upstream_eval"),
        lambda said: said["episodes"][0]["reset_kwargs"].update(seed=17),
        lambda said: said["episodes"][0]["reset_kwargs"].update(options={"layout": 1}),
    ],
)
def test_what_the_json_says_counts(asked, trajectory, change):
    read(trajectory)
    path = trajectory.with_suffix(".json")
    said = json.loads(path.read_text())
    change(said)
    path.write_text(json.dumps(said))
    read(trajectory)
    assert len(asked) == 2


@pytest.mark.parametrize("package", ["robocas-ms3", "mani_skill", "sapien"])
def test_versions_count(asked, trajectory, monkeypatch, package):
    read(trajectory)
    now = {**data.versions(), package: "99"}
    monkeypatch.setattr(data, "versions", lambda: now)
    read(trajectory)
    assert len(asked) == 2


@pytest.mark.parametrize("keep", [0, 50, 400])
def test_what_is_damaged_is_made_anew(asked, trajectory, tmp_path, keep):
    whole = read(trajectory)
    [path] = kept(tmp_path)
    path.write_bytes(path.read_bytes()[:keep])
    assert (read(trajectory)._told == whole._told).all()
    read(trajectory)
    assert len(asked) == 2 and kept(tmp_path) == [path]
