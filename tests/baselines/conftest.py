"""A made-up baseline, and a small dataset for real ones."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from made_up_baseline import MADE_UP
from made_up_dataset import made_up_dataset
from made_up_runs import train

from robocas_ms3.baselines.registry import BASELINES
from robocas_ms3.cli.main import run
from robocas_ms3.cli.train import COMMANDS, Other, command

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def made_up(monkeypatch):
    """A function that changes the made-up baseline, which is registered."""

    def change(**values):
        monkeypatch.setitem(BASELINES.builtin, "made-up", lambda: replace(MADE_UP, **values))

    change()
    monkeypatch.setitem(COMMANDS, "made-up", command("made-up", Other))
    return change


@pytest.fixture(scope="session")
def short(tmp_path_factory):
    """A protocol: three episodes of paper-v1, 60 steps each."""
    made = tmp_path_factory.mktemp("protocol")
    plan = yaml.safe_load((ROOT / "scripts" / "protocols" / "paper-v1.yaml").read_text())
    plan["rules"] |= {"name": "short", "max_steps": 60}
    plan["parts"] = [{"config": "pick_upstream_eval", "count": 3, "first_seed": 130000}]
    (made / "plan.yaml").write_text(yaml.safe_dump(plan))
    assert run(["eval", "freeze", str(made / "plan.yaml"), "--out", str(made / "short")]) == 0
    return str(made / "short")


@pytest.fixture
def data(tmp_path):
    path = tmp_path / "data.h5"
    path.write_text("demonstrations")
    return path


@pytest.fixture
def usual_umask():
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.fixture
def whole(usual_umask, made_up, data, tmp_path):
    train("made-up", data, tmp_path / "whole")
    return tmp_path / "whole"


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A dataset of six episodes of seven steps, 64 x 48 pictures, that nobody may change; five are to train on."""
    return made_up_dataset(tmp_path_factory.mktemp("baselines"))
