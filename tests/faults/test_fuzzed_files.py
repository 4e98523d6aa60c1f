"""Whatever files of others hold, there is an answer or one of our errors, of one line."""

import io
import json
import shutil
from pathlib import Path

import made_up_results
import numpy as np
import pytest
from fuzzing import VALUES, flipped, twist_file
from synthetic import RayCaster, write_trajectory

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.cli.layouts import Info, info
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.paths import builtin_packs_dir
from robocas_ms3.core.poses import planar
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.writing.convert import convert
from robocas_ms3.datasets.writing.settings import ConversionSettings
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols
from robocas_ms3.evaluation.report.comparison import comparison
from robocas_ms3.evaluation.report.page import page
from robocas_ms3.evaluation.report.tables import markdown
from robocas_ms3.scenes.cache import ABOUT, LayoutCache
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.table import FrozenLayouts, LayoutTable, write_frozen, write_table


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
    settings = {"size": (64, 48), "video": False, "open_renderer": RayCaster}
    convert(ConversionSettings(trajectory, folder / "robocas", embeddings=False, **settings))
    convert_lerobot(ConversionSettings(trajectory, folder / "lerobot", **settings))
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


NAMES = ["one", "three", "two"]
LAYOUT = Layout(
    ("two", "one", "two"),
    np.stack([planar(0.1 * i, 0.2, 0.6, i) for i in range(3)]),
    planar(0.7, 0.15, 0, 1.5),
    planar(1.3, 0.9, 0.6, 0),
    target=1,
)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache whose layouts are drawn at no cost: all the same one."""
    pack = load_pack("builtin")
    cache = LayoutCache(SceneModel.load(load_task_config("pick_table_scattered"), pack, pack), tmp_path)
    layout = Layout(
        tuple(cache._names[:3]), *(getattr(LAYOUT, f) for f in ("object_poses", "robot_pose", "basket_pose")), 1
    )
    monkeypatch.setattr(cache._sample, "make", lambda *_: layout)
    return cache


def same(one, other):
    return one.object_ids == other.object_ids and np.array_equal(one.object_poses, other.object_poses)


def test_a_damaged_layout_of_a_cache_is_made_again(cache):
    whole_layout = cache.get(0, 0)
    path = cache.path(0, 0)
    whole = path.read_bytes()
    for seed in range(40):
        path.write_bytes(flipped(whole, seed))
        assert same(cache.get(0, 0), whole_layout), f"seed {seed}"
    arrays = dict(np.load(io.BytesIO(whole)))
    rng = np.random.default_rng(0)
    for name in arrays:  # a whole file of other arrays
        for value in (np.zeros(0), np.array("x"), rng.random((3, 4, 4)), np.array(9), np.array([True]), None):
            others = {**arrays, name: value} if value is not None else {k: a for k, a in arrays.items() if k != name}
            np.savez(path, **others)
            if not same(cache.get(0, 0), whole_layout):
                raise AssertionError(f"{name} {value}")


def test_caches_with_damaged_notes_are_listed(cache, capsys):
    cache.get(0, 0)
    path = cache.folder / ABOUT
    whole = json.loads(path.read_text())
    for seed in range(60):
        twist_file(path, whole, seed)
        assert info(Info(folder=cache.folder.parent)) == 0, f"seed {seed}"
    for value in VALUES:
        path.write_text(json.dumps(value))
        assert info(Info(folder=cache.folder.parent)) == 0, value
        assert "damaged" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["table", "frozen"])
def test_files_of_many_layouts(tmp_path, kind):
    path, pairs = tmp_path / "layouts.npy", [(0, 0)] if kind == "frozen" else [(0, 0), (0, 1)]
    if kind == "table":
        write_table(path, NAMES, dict.fromkeys(pairs, LAYOUT))
    else:
        write_frozen(path, NAMES, {0: LAYOUT})

    def read(path):
        if kind == "table":
            table = LayoutTable(path, NAMES)
            found = [table.layout(pair) for pair in pairs]
            assert table.object_ids(0) is None or set(table.object_ids(0)) <= set(NAMES)
        else:
            found = [FrozenLayouts(path, NAMES)(*pair) for pair in pairs]
        for layout in found:
            if layout is not None:
                layout.check(NAMES)

    whole = path.read_bytes()
    refused = 0
    for seed in range(50):
        path.write_bytes(flipped(whole, seed))
        refused += attempt(read, path, seed)
    assert refused > 25


@pytest.mark.parametrize("name", [results.RUN, results.OUTCOMES])
def test_files_of_a_result(tmp_path, name):
    root = tmp_path / "result"
    made_up_results.write(root, [made_up_results.outcome(i, came_to=7 - i) for i in range(3)])

    def read(folder):
        found = results.read(folder)
        assert markdown(found)
        assert page(found)
        assert comparison([found, found])
        results.parts_of([folder])

    read(root)
    whole = (root / name).read_bytes()
    first, *others = whole.splitlines() if name == results.OUTCOMES else [whole]
    for seed in range(20):
        (root / name).write_bytes(flipped(whole, seed))
        attempt(read, root, seed)
        text = twist_file(root / name, json.loads(first), seed)
        (root / name).write_bytes(b"\n".join([text.encode(), *others, b""]))
        attempt(read, root, seed)


def test_deep_json_is_refused(made, tmp_path):
    """A file of brackets takes no reader down."""
    deep = "[" * 100_000
    root = tmp_path / "result"
    made_up_results.write(root, [made_up_results.outcome(0)])
    (root / results.RUN).write_text(deep)
    assert attempt(results.read, root, 0)
    for kind, name, read in (
        ("robocas", "data_info.json", read_dataset),
        ("lerobot", "meta/info.json", lambda root: check_lerobot(root) and None),
    ):
        shutil.copytree(made / kind, tmp_path / kind)
        (tmp_path / kind / name).write_text(deep)
        attempt(read, tmp_path / kind, 0)
