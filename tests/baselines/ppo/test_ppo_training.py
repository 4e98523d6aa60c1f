"""Learning in an environment of a few lines: it learns, stops, goes on, and keeps what it knew. And once for real."""

import csv

import pytest
import torch
from safetensors.torch import load_file

from robocas_ms3.baselines.policy import RunPolicy
from robocas_ms3.baselines.ppo import BASELINE
from robocas_ms3.baselines.session import Said, train_run
from robocas_ms3.core.errors import TrainingError

STEPS = 4  # of an episode


class LeftOrRight:
    """Pays an action for the sign of what is seen; episodes of a few steps."""

    def __init__(self, count, config):
        self.count, self.seeds, self.draws = count, [], torch.Generator()

    def reset(self, seed):
        self.seeds.append(seed)
        self.draws.manual_seed(seed)
        self.at, self.paid = 0, torch.zeros(self.count)
        return self._look(), {}

    def _look(self):
        self.obs = torch.randint(0, 2, (self.count, 1), generator=self.draws) * 2.0 - 1
        return self.obs

    def step(self, action):
        reward = (self.obs * action)[:, 0].clamp(-1, 1)
        self.at, self.paid = self.at + 1, self.paid + reward
        over = torch.full((self.count,), self.at == STEPS)
        obs, info = self._look(), {}
        if self.at == STEPS:
            final = {
                "episode": {"return": self.paid},
                "reward_terms": {"grasp": (self.paid > 2).float()},
                "target_lifted": self.paid > 3,
                "success": self.paid > 3.9,
            }
            info = {"final_observation": obs, "final_info": final, "_final_info": over}
            self.at, self.paid = 0, torch.zeros(self.count)
        return obs, reward, torch.zeros_like(over), over, info

    def close(self):
        pass


class MadeUpTrials:
    name, hash, facts, made = "left or right", "1234", {"observed": 1, "acted": 1, "rate_hz": 5}, []  # noqa: RUF012

    def __init__(self, config, device):
        self.config, self.episodes = config, config.layouts
        self.envs = self.make(config.envs, 0, config.layouts - 1)
        self.made.append(self.envs)

    def __len__(self):
        return self.config.train.steps

    def make(self, count, first_seed, last_seed):
        return LeftOrRight(count, self.config)

    def close(self):
        pass


SMALL = {"width": 16, "envs": 4, "trials": 20, "layouts": 10, "train": {"steps": 1280, "batch_size": 64}}


@pytest.fixture
def made_up(monkeypatch):
    monkeypatch.setattr(type(BASELINE), "trials", MadeUpTrials)
    monkeypatch.setattr(MadeUpTrials, "made", [])


def lines(run, split="train"):
    with (run / "metrics.csv").open() as file:
        return [row for row in csv.DictReader(file) if row["split"] == split]


def interrupt_at(step):
    def look(done, of):
        if done == step:
            raise KeyboardInterrupt

    return Said(step=look)


def test_it_learns(made_up, tmp_path):
    record = train_run("ppo", None, tmp_path / "run", SMALL, device="cpu")
    assert (record.data.name, record.data.hash, record.data.episodes) == ("left or right", "1234", 10)
    rows = lines(tmp_path / "run")
    assert [int(row["step"]) for row in rows] == list(range(64, 1281, 64))
    assert abs(float(rows[0]["return"])) < 1.5
    (tried,) = lines(tmp_path / "run", "val")
    assert float(tried["return"]) > 2
    assert RunPolicy(tmp_path / "run").describe()["steps"] == 1280


def test_ctrl_c_keeps_what_was_learned(made_up, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train_run("ppo", None, run, SMALL, device="cpu", said=interrupt_at(640))
    kept, weights = load_file(run / "checkpoint.safetensors"), load_file(run / "weights.safetensors")
    assert not lines(run, "val")
    assert weights["count"].item() == pytest.approx(640, abs=1e-3)
    assert int(kept["episodes.played"]) == 640 // STEPS
    steps = []
    train_run("ppo", None, run, device="cpu", said=Said(step=lambda done, of: steps.append(done)))
    assert steps == list(range(640, 1281, 64))
    assert [int(row["step"]) for row in lines(run)] == list(range(64, 1281, 64))
    assert load_file(run / "weights.safetensors")["count"].item() == pytest.approx(1280, abs=1e-3)
    first, second = (envs.seeds[0] for envs in MadeUpTrials.made)
    assert (first, second) == (0, 640 // STEPS % 10)  # the layouts after those that were played
    before = (run / "weights.safetensors").read_bytes()
    train_run("ppo", None, run, device="cpu")  # what is done is done
    assert (run / "weights.safetensors").read_bytes() == before
    assert len(lines(run, "val")) == 1


def test_what_goes_on_is_what_was_there(made_up, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train_run("ppo", None, run, SMALL, device="cpu", said=interrupt_at(640))
    before = load_file(run / "checkpoint.safetensors")
    with pytest.raises(KeyboardInterrupt):
        train_run("ppo", None, run, device="cpu", said=interrupt_at(640))  # before the next update
    again = load_file(run / "checkpoint.safetensors")
    assert before.keys() == again.keys()
    assert any(name.startswith("optimizer.") for name in before)
    assert all(torch.equal(before[name], again[name]) for name in before)


def test_a_gradient_that_is_no_number_is_not_saved(made_up, monkeypatch, tmp_path):
    """Not even that of an update's last step, whose losses are numbers."""
    clip, calls = torch.nn.utils.clip_grad_norm_, []

    def spoil(parameters, most):
        parameters = list(parameters)
        calls.append(len(parameters))
        if len(calls) == 20 * 10 * 4:  # updates, epochs, minibatches: the last of all
            parameters[0].grad.fill_(torch.nan)
        return clip(parameters, most)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", spoil)
    changes = {**SMALL, "train": {**SMALL["train"], "save_every": 64}}
    with pytest.raises(TrainingError, match="the gradient is no number any more"):
        train_run("ppo", None, tmp_path / "run", changes, device="cpu")
    saved = load_file(tmp_path / "run" / "checkpoint.safetensors")
    assert all(tensor.isfinite().all() for tensor in saved.values())


def test_data_is_refused(made_up, tmp_path):
    with pytest.raises(TrainingError, match="ppo learns by trying, of no data. Leave it out"):
        train_run("ppo", tmp_path, tmp_path / "run", SMALL, device="cpu")
    with pytest.raises(TrainingError, match="--data: small learns from data"):
        train_run("small", None, tmp_path / "run", device="cpu")


def test_other_scenes_do_not_go_on(made_up, monkeypatch, tmp_path):
    train_run("ppo", None, tmp_path / "run", SMALL | {"trials": 0}, device="cpu")
    monkeypatch.setattr(MadeUpTrials, "hash", "5678")
    with pytest.raises(TrainingError, match="a run on another dataset"):
        train_run("ppo", None, tmp_path / "run", device="cpu")


@pytest.mark.slow
def test_a_short_run_in_the_simulator(tmp_path):
    run = tmp_path / "run"
    small = {"envs": 2, "workers": 1, "layouts": 2, "trials": 2, "epochs": 1, "train": {"steps": 128, "batch_size": 64}}
    train_run("ppo", None, run, small, device="cpu")
    rows = lines(run)
    assert [row["step"] for row in rows] == ["64", "128"]
    assert 0 < float(rows[-1]["return"]) < 20
    assert RunPolicy(run).spec.state
