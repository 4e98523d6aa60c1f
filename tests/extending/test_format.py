"""A dataset format of another package: the page's code, installed, through every command that takes datasets."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from strangers import install
from synthetic import RayCaster, write_trajectory

from robocas_ms3.cli.main import run
from robocas_ms3.core.extensions import Registry
from robocas_ms3.datasets import RoboCASDataset, formats
from robocas_ms3.datasets.conversion import convert as conversion
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.formats import detect_format, open_source
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.training.options import SampleOptions


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """Its package is installed; nothing of it is left behind."""
    folder = install("A dataset format", tmp_path / "site")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr("robocas_ms3.datasets.conversion.env_renderer.EnvRenderer", RayCaster)
    table = Registry("dataset format", formats.GROUP, formats.Format, formats.FORMATS.builtin)
    monkeypatch.setattr(formats, "FORMATS", table)  # as if the process had begun now
    yield folder
    sys.modules.pop("toy_format", None)


@pytest.fixture
def both(stranger, tmp_path, capsys):
    """The same recordings as a toy, by the command line, and as a RoboCAS folder."""
    file = write_trajectory(tmp_path / "F.h5", seeds=(3, 4, 5))
    assert run(["convert", str(file), "--to", "toy", "--out", str(tmp_path / "toy")]) == 0
    assert "3 episodes, 21 steps" in capsys.readouterr().out
    conversion.convert(
        ConversionSettings(file, tmp_path / "folder", embeddings=False, video=False, open_renderer=RayCaster)
    )
    return tmp_path / "toy", tmp_path / "folder"


def test_it_is_three_files_and_known_by_them(both):
    toy, folder = both
    assert sorted(path.name for path in toy.iterdir()) == ["about.json", "arrays.npz", "images.npz"]
    assert (detect_format(toy).name, detect_format(folder).name) == ("toy", "robocas")


def test_it_trains_as_a_robocas_folder_does(both):
    ours, theirs = (
        RoboCASDataset(root, SampleOptions(split="all", size=None, depth=True, subgoals=True)) for root in both[::-1]
    )
    assert len(theirs) == len(ours) > 0
    for one, other in zip(ours, theirs, strict=True):
        for key, value in one.items():
            assert torch.equal(value, other[key]) if torch.is_tensor(value) else value == other[key], key
    split = {root: (open_source(root).split("train"), open_source(root).split("val")) for root in both}
    assert split[both[0]] == split[both[1]]  # by the seeds
    ranges = [open_source(root).action_space()["relative_position"] for root in both]
    np.testing.assert_allclose(*ranges)


def test_it_is_counted_checked_shown_and_converted(both, tmp_path, capsys):
    toy, folder = both
    counted = {}
    for root in (folder, toy):
        assert run(["stats", str(root), "--json"]) == 0
        counted[root] = {**json.loads(capsys.readouterr().out), "path": "", "split": {}}
    assert counted[toy] == counted[folder]
    assert run(["validate", str(toy)]) == 0
    assert "3 episodes, 21 steps, valid" in capsys.readouterr().out
    assert run(["video", str(toy), "--out", str(tmp_path / "video")]) == 0
    assert len(list((tmp_path / "video").glob("*.mp4"))) == 3
    made = [convert_lerobot(ConversionSettings(root, tmp_path / root.name.upper())).episodes for root in (toy, folder)]
    assert [[e.steps for e in episodes] for episodes in made] == [[7, 7, 7]] * 2
    files = [
        {p.relative_to(root): p.read_bytes() for p in root.rglob("*.mp4")}
        for root in (tmp_path / "TOY", tmp_path / "FOLDER")
    ]
    assert files[0] == files[1] != {}


def test_what_is_wrong_with_it_is_said(both, capsys):
    toy, _ = both
    with np.load(toy / "arrays.npz") as content:
        arrays = dict(content)
    arrays["1/rel_pos"] = arrays["1/rel_pos"][:-1]
    np.savez(toy / "arrays.npz", **arrays)
    assert run(["validate", str(toy)]) == 1
    assert "arrays.npz/1, rel_pos: expected shape (7, 3), found shape (6, 3)" in capsys.readouterr().out


def test_a_format_that_there_is_not(stranger, tmp_path, capsys):
    file = write_trajectory(tmp_path / "F.h5")
    assert run(["convert", str(file), "--to", "rlds", "--out", str(tmp_path / "out")]) == 2
    assert "expected one of ['lerobot', 'robocas', 'toy']" in capsys.readouterr().err
    assert run(["convert", str(file), "--to", "toy", "--append", "--out", str(tmp_path / "out")]) == 2
    assert "--append: this option does not apply to a toy dataset" in capsys.readouterr().err


def test_a_format_that_fails_at_a_path_holds_it_not(both, monkeypatch):
    """One that looks for files in what is no folder, say."""
    toy = formats.FORMATS["toy"]
    monkeypatch.setitem(formats.FORMATS._loaded, "toy", replace(toy, matches=lambda path: any(path.iterdir())))
    trajectory = both[0].with_name("F.h5")
    assert detect_format(trajectory).name == "trajectory"
