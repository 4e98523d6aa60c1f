"""Stub baseline that trains in milliseconds.

`python stub_baseline.py DATA OUT` trains it in several processes (RANK, WORLD_SIZE): an uninterrupted run, and a run
that crashes and continues.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from training_runs import stop_at, train

from robocas_ms3.baselines.baseline import Baseline, BaselineConfig, TrainSettings
from robocas_ms3.baselines.registry import BASELINES
from robocas_ms3.core.errors import DatasetError, EmptySplitError
from robocas_ms3.evaluation.policy import PolicySpec


class StubConfig(BaselineConfig):
    width: int = 4
    broken_at: int = -1  # sample with a NaN target
    damaged_at: int = -1  # sample that cannot be read
    steep_at: int = -1  # sample with a finite loss and a NaN gradient
    train: TrainSettings = TrainSettings(
        steps=40, batch_size=4, log_every=4, validate_every=20, save_every=10, warmup_steps=3, ema=0.9, precision="fp32"
    )


class StubSamples:
    episodes = 3

    def __init__(self, broken_at, steep_at, damaged_at=-1):
        self.damaged_at = damaged_at
        rng = np.random.default_rng(0)
        self.x = torch.from_numpy(rng.normal(size=(30, 3)).astype(np.float32))
        self.y = self.x.sum(1, keepdim=True)
        if broken_at >= 0:
            self.y[broken_at] = torch.nan
        self.steep = torch.arange(30) == steep_at
        self.facts = {"inputs": 3}

    def __len__(self):
        return len(self.x)

    def __getitems__(self, indices):
        if self.damaged_at in indices:
            raise DatasetError("damaged", where=f"sample {self.damaged_at}", fix="Repair it.")
        return {"x": self.x[indices], "y": self.y[indices], "steep": self.steep[indices]}


class StubModel(torch.nn.Module):
    def __init__(self, config, facts):
        super().__init__()
        layers = torch.nn.Linear(facts["inputs"], config.width), torch.nn.Linear(config.width, 1)
        self.net = torch.nn.Sequential(layers[0], torch.nn.Dropout(0.3), layers[1])  # random, so that a continued run
        # needs the state of the generator

    def forward(self, batch):
        error = (self.net(batch["x"]) - batch["y"]).square().mean()
        if batch["steep"].any():
            error = error + (0 * self.net[0].weight).sum().sqrt()
        high = batch["x"][:, 0].clamp(min=0)
        high_sum = torch.stack([high.sum(), (high > 0).sum()])  # a metric of only some samples
        return {"loss": error, "double": 2 * error.detach(), "high": high_sum}


class StubPolicy:
    spec = PolicySpec(language="none")

    def reset(self, episodes):
        pass

    def act(self, observations):
        return np.zeros((len(observations.envs), 7))


def read_samples(config, folder, split, on_read):
    if split == "val" and folder.read_text() == "few":
        raise EmptySplitError("this split holds no episodes", where=folder)
    if split == "val" and folder.read_text() == "damaged":
        raise DatasetError("this split is damaged", where=folder)
    bad = config.broken_at, config.steep_at, config.damaged_at
    return StubSamples(*(bad if split == "train" else (-1, -1)))


STUB = Baseline("stub", 1, StubConfig, StubModel, lambda config, facts, model: StubPolicy(), read_samples)


if __name__ == "__main__":
    BASELINES.builtin["stub"] = lambda: STUB
    data, out = map(Path, sys.argv[1:])
    train("stub", data, out / "whole")
    try:
        train("stub", data, out / "again", progress=stop_at(17, RuntimeError("stopped")))
    except RuntimeError:
        train("stub", data, out / "again")
