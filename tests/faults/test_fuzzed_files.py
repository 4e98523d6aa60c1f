"""Whatever files of others hold, there is an answer or one of our errors, of one line."""

import json
import shutil
from pathlib import Path

import pytest
from fuzzing import flipped, twist_file
from synthetic import RayCaster, write_trajectory

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.writing.convert import convert
from robocas_ms3.errors import RobocasError
from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols
from robocas_ms3.paths import builtin_packs_dir


def read_dataset(root):
    dataset = Dataset(root)
    for side in ("train", "val", "all"):
        dataset.split(side)
    for number in dataset.numbers[:1]:
        episode = dataset.episode(number)
        assert episode.arrays
        assert episode.goals is not None
        assert episode.layout is not None


def attempt(read, path, seed):
    """Gives whether it was refused."""
    try:
        read(path)
    except RobocasError as error:
        assert "\n" not in str(error), f"seed {seed}"
        return True
    except Exception as error:
        raise AssertionError(f"seed {seed}") from error
    return False


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small dataset of each kind."""
    folder = tmp_path_factory.mktemp("made")
    trajectory = write_trajectory(folder / "trajectory.h5", seeds=(3, 4))
    pictures = Pictures(size=(64, 48))
    convert(trajectory, folder / "robocas", embeddings=False, open_source=RayCaster, pictures=pictures)
    convert_lerobot(trajectory, folder / "lerobot", open_source=RayCaster, pictures=pictures)
    return folder


@pytest.mark.parametrize("name", ["data_info.json", "conversion.json", "episode_0000000/scene.json"])
@pytest.mark.parametrize("read", [validate, read_dataset])
def test_json_of_a_dataset(made, tmp_path, name, read):
    root = tmp_path / "dataset"
    shutil.copytree(made / "robocas", root)
    whole = json.loads((root / name).read_text())
    for seed in range(25):
        twist_file(root / name, whole, seed)
        attempt(read, root, seed)


@pytest.mark.parametrize("name", ["episode_info.npz", "base_camera/intrinsic.npy", "base_camera/rgb/0001.png"])
def test_bytes_of_an_episode(made, tmp_path, name):
    root = tmp_path / "dataset"
    shutil.copytree(made / "robocas", root)
    path = root / "episode_0000000" / name
    whole, found = path.read_bytes(), 0
    for seed in range(16):
        path.write_bytes(flipped(whole, seed))
        attempt(read_dataset, root, seed)
        found += bool(validate(root).violations)
    assert found > 8


@pytest.mark.parametrize("name", ["meta/info.json", "meta/stats.json", "meta/robocas/conversion.json"])
def test_json_of_a_lerobot_dataset(made, tmp_path, name):
    root = tmp_path / "dataset"
    shutil.copytree(made / "lerobot", root)
    whole = json.loads((root / name).read_text())
    for seed in range(20):
        twist_file(root / name, whole, seed)
        attempt(check_lerobot, root, seed)


def test_manifest_of_a_pack(tmp_path):
    whole = json.loads((builtin_packs_dir() / "builtin" / "manifest.json").read_text())
    whole["assets"] = whole["assets"][:2]
    refused = 0
    for seed in range(150):
        folder = tmp_path / str(seed)
        folder.mkdir()
        twist_file(folder / "manifest.json", whole, seed)
        refused += attempt(load_pack, folder, seed)
    assert refused > 100


def test_files_of_a_protocol(tmp_path):
    root = tmp_path / "protocol"
    shutil.copytree(Path(next(iter(shipped_protocols().values()))), root)
    for path in sorted(file for file in root.iterdir() if file.is_file()):
        whole = path.read_bytes()
        for seed in range(30):
            path.write_bytes(flipped(whole, seed))
            attempt(load_protocol, root, seed)
        path.write_bytes(whole)
