"""A baseline that learns nothing worth knowing, in milliseconds; and a small dataset for those that do."""

import numpy as np
import pytest
import torch
from synthetic import RayCaster, made_up_vectors, write_trajectory

from robocas_ms3.baselines.baseline import BaselineConfig, TrainSettings
from robocas_ms3.baselines.table import BASELINES
from robocas_ms3.datasets.writing.convert import convert
from robocas_ms3.errors import DatasetError
from robocas_ms3.evaluation.policy import Wants


class MadeUpConfig(BaselineConfig):
    width: int = 4
    broken_at: int = -1  # sample whose target is no number
    train: TrainSettings = TrainSettings(
        steps=40, batch_size=4, log_every=4, check_every=20, save_every=10, warmup_steps=3, ema=0.9, precision="fp32"
    )


class MadeUpSamples:
    episodes = 3

    def __init__(self, broken_at):
        rng = np.random.default_rng(0)
        self.x = torch.from_numpy(rng.normal(size=(30, 3)).astype(np.float32))
        self.y = self.x.sum(1, keepdim=True)
        if broken_at >= 0:
            self.y[broken_at] = torch.nan
        self.facts = {"inputs": 3}

    def __len__(self):
        return len(self.x)

    def __getitems__(self, indices):
        return {"x": self.x[indices], "y": self.y[indices]}


class MadeUpModel(torch.nn.Module):
    def __init__(self, config, facts):
        super().__init__()
        layers = torch.nn.Linear(facts["inputs"], config.width), torch.nn.Linear(config.width, 1)
        self.net = torch.nn.Sequential(layers[0], torch.nn.Dropout(0.3), layers[1])  # random, so that a resume has to
        # have the generator's state too

    def forward(self, batch):
        error = (self.net(batch["x"]) - batch["y"]).square().mean()
        return {"loss": error, "double": 2 * error.detach()}


class MadeUpPolicy:
    wants = Wants(language="none")

    def __init__(self, model):
        self.model = model

    def reset(self, starts):
        pass

    def act(self, observations):
        return np.zeros((len(observations.envs), 7))


class MadeUp:
    name, version, about, Config = "made-up", 1, "for tests", MadeUpConfig

    def data(self, config, folder, split, on_read):
        if split == "val" and folder.read_text() == "few":
            raise DatasetError("this split holds no episodes", where=folder)
        return MadeUpSamples(config.broken_at if split == "train" else -1)

    def model(self, config, facts):
        return MadeUpModel(config, facts)

    def policy(self, config, facts, model):
        return MadeUpPolicy(model)


@pytest.fixture
def made_up(monkeypatch):
    monkeypatch.setitem(BASELINES.builtin, "made-up", MadeUp)
    return MadeUp


@pytest.fixture
def data(tmp_path):
    path = tmp_path / "data.h5"
    path.write_text("demonstrations")
    return path


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A dataset of six episodes of seven steps, 64 x 48 pictures, that nobody may change; five are to train on."""
    made = tmp_path_factory.mktemp("baselines")
    trajectory = write_trajectory(made / "F.h5", seeds=range(3, 9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("robocas_ms3.datasets.writing.convert.embed_texts", made_up_vectors)
        convert(trajectory, made / "dataset", open_source=RayCaster)
    return made / "dataset"
