"""An episode that can't be written is skipped: the others make a valid dataset, and an error names it."""

import json

import h5py
import numpy as np
import pytest
from managing import convert_made_up as run
from managing import files_of
from synthetic import RayCaster, render_by, write_trajectory

from robocas_ms3.cli.main import run as run_command
from robocas_ms3.core.errors import AssetError, IncompleteDatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion import convert as conversion
from robocas_ms3.datasets.sources.reader import Dataset

SEEDS = tuple(range(10, 16))


class Breaking(RayCaster):
    """Can't render one of the recordings."""

    seed = 13

    def frames(self, recording, samples):
        for step, frame in enumerate(super().frames(recording, samples)):
            if recording.seed == self.seed and step == 3:
                raise AssetError("no such object", where="cube")
            yield frame


class OfOddSeeds(RayCaster):
    def load_scene(self, recording):
        if recording.seed % 2:
            raise RuntimeError("odd")


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """Recordings, and their dataset without errors."""
    folder = tmp_path_factory.mktemp("many")
    trajectory = write_trajectory(folder / "trajectory.h5", seeds=SEEDS, steps=16)
    run(trajectory, folder / "whole")
    return trajectory, folder / "whole"


def spoil(path, number, how):
    with h5py.File(path, "a") as file:
        if how == "no states":
            del file[f"traj_{number}/env_states"]
        elif how == "NaN":
            file[f"traj_{number}/env_states/actors/object_1"][2] = np.nan


@pytest.mark.parametrize("how", ["no states", "NaN"])
def test_damaged_recording_is_skipped(many, tmp_path, how):
    _, whole = many
    trajectory, out = write_trajectory(tmp_path / "trajectory.h5", seeds=SEEDS, steps=16), tmp_path / "out"
    spoil(trajectory, 3, how)
    with pytest.raises(
        IncompleteDatasetError, match=r"out: 1 episode could not.*found episode_0000003: .*traj_3"
    ) as error:
        run(trajectory, out)
    assert "\n" not in str(error.value)
    assert validate(out).violations == []
    expected, found = files_of(whole), files_of(out)
    different = {name for name in expected if name not in found or found[name] != expected[name]}
    assert {name.partition("/")[0] for name in different} == {"conversion.json", "data_info.json", "episode_0000003"}
    said = json.loads((out / "conversion.json").read_text())
    assert list(said["skipped"]) == ["3"]
    assert said["skipped"]["3"]["reason"] in str(error.value)
    for side, sides in zip(("train", "val"), Dataset(whole).splits, strict=True):
        assert Dataset(out).split(side) == [number for number in sides if number != 3]
    run(write_trajectory(trajectory, seeds=SEEDS, steps=16), out)  # repaired
    assert files_of(out) == files_of(whole)


def test_only_validation_episode_keeps_its_split(many, tmp_path):
    """It gets its split back, whatever was converted in between."""
    trajectory, whole = many
    (val,) = Dataset(whole).splits[1]

    class OfVal(Breaking):
        seed = SEEDS[val]

    for _ in range(2):
        with pytest.raises(IncompleteDatasetError, match=f"episode_{val:07d}"):
            run(trajectory, tmp_path / "out", open_renderer=OfVal)
        assert validate(tmp_path / "out").violations == []
        assert Dataset(tmp_path / "out").splits[1] == []
    run(trajectory, tmp_path / "out")
    assert files_of(tmp_path / "out") == files_of(whole)


def test_append_while_episodes_are_skipped(many, tmp_path):
    trajectory, _ = many
    more = write_trajectory(tmp_path / "more.h5", seeds=(50, 51), steps=16)
    with pytest.raises(IncompleteDatasetError):
        run(trajectory, tmp_path / "out", open_renderer=OfOddSeeds)
    run(more, tmp_path / "out", append=True)
    assert validate(tmp_path / "out").violations == []
    ledger = json.loads((tmp_path / "out" / "conversion.json").read_text())
    assert list(ledger["skipped"]) == ["1", "3", "5"]
    assert [ledger["episodes"][number]["seed"] for number in ("4", "6", "7")] == [14, 50, 51]
    done = run(trajectory, tmp_path / "out")
    assert [episode.number for episode in done.episodes] == [1, 3, 5]
    assert validate(tmp_path / "out").violations == []
    ledger = json.loads((tmp_path / "out" / "conversion.json").read_text())
    assert list(ledger["episodes"]) == [str(number) for number in range(8)]
    assert "skipped" not in ledger


def test_unreadable_texts_skip_their_episode(many, tmp_path, monkeypatch):
    trajectory = write_trajectory(tmp_path / "trajectory.h5", seeds=SEEDS, steps=16)
    content = json.loads(trajectory.with_suffix(".json").read_text())
    del content["episodes"][3]["robocas"]["instruction"]
    trajectory.with_suffix(".json").write_text(json.dumps(content))
    embedder = type("Embedder", (), {"__call__": lambda self, texts: np.eye(384, dtype=np.float32)[: len(texts)]})
    monkeypatch.setattr("robocas_ms3.scenes.language.embed.TextEmbedder", embedder)
    with pytest.raises(IncompleteDatasetError, match="episode_0000003: .*traj_3: invalid episode entry: "):
        run(trajectory, tmp_path / "out", embeddings=True)
    assert validate(tmp_path / "out").violations == []


@pytest.mark.parametrize("to", ["robocas", "lerobot"])
def test_the_command(many, tmp_path, monkeypatch, capsys, to):
    """Exit status, one line with the fix, and --skip-errors."""
    if to == "lerobot":
        pytest.importorskip("av", reason="needs the extra 'lerobot'")
        from robocas_ms3.datasets.lerobot import convert as lerobot

        owner, name = lerobot, "convert_lerobot"
    else:
        owner, name = conversion, "convert"
    whole = getattr(owner, name)
    monkeypatch.setattr(owner, name, render_by(Breaking, whole))
    out = tmp_path / "out"
    command = ["convert", str(many[0]), "--to", to, "--out", str(out), "--no-embeddings", "--no-video"]
    assert run_command(command) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert "1 episode could not be written (found episode_0000003: cube: no such object). " in line
    assert "--skip-errors" in line
    assert run_command([*command, "--skip-errors"]) == 0
    assert run_command(["validate", str(out)]) == 0
    assert "5 episodes" in capsys.readouterr().out
    monkeypatch.setattr(owner, name, render_by(RayCaster, whole))
    assert run_command(command) == 0
    assert run_command(["validate", str(out)]) == 0
    count = 6 if to == "robocas" else 5  # LeRobot's numbers have no gap that it could fill
    assert f"{count} episodes" in capsys.readouterr().out
