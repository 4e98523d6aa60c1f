"""Statistics of a dataset: counts computed by hand, plots, invalid input."""

import json
import shutil
import sys

import managing
import numpy as np
import pytest
from PIL import Image

from robocas_ms3.cli.stats import Stats as Command
from robocas_ms3.cli.stats import main
from robocas_ms3.core.errors import DatasetError, MissingExtraError
from robocas_ms3.datasets.actions import ACTION_NAMES
from robocas_ms3.datasets.statistics.collect import collect_statistics, compute_histogram, summarize_values
from robocas_ms3.datasets.statistics.layouts import ObjectPositions, Surface, make_layout_map
from robocas_ms3.datasets.statistics.plots import PLOTS, write_stats

TABLE = Surface("table, top", x=0.9, y=1.0, yaw=-np.pi / 2, region=[[0.0, -0.1], [0.1, 0.1]])
CONFIG = {
    "furniture": {"table": {"pose": {"position": [0.9, 1.0, 0.0], "yaw_deg": -90.0}}},
    "surface": {"furniture": "table", "name": "top", "min_xy": [0.0, -0.1], "max_xy": [0.1, 0.1]},
}


@pytest.fixture
def described(dataset):
    """A dataset with scenes: a cup as target, a jar, and a jar outside the scene."""
    for number, y in ((0, 0.99), (1, 0.94)):
        path = dataset / f"episode_{number:07d}/scene.json"
        scene = json.loads(path.read_text())
        poses = [[0.93, y, 0.65, 1, 0, 0, 0], [0.87, 0.96, 0.65, 1, 0, 0, 0], [0, 0, -5, 1, 0, 0, 0]]
        scene["layout"] = {"object_ids": ["cup", "jar", "jar"], "poses": poses, "present": [True, True, False]}
        scene["objects"] = [{"slot": 0, "id": "cup", "name": "red cup"}, {"slot": 1, "id": "jar", "name": "jar"}]
        scene["target"] = {"slot": 0, "asset_id": "cup", "name": "red cup"}
        scene["config"] = CONFIG
        scene["recorded"] = {"instruction_template": "pick/train/07", "relation": "nearest" if number else ""}
        path.write_text(json.dumps(scene))
    return dataset


def test_counts_of_a_folder(described):
    found = collect_statistics(described).as_json()
    assert (found["episodes"], found["steps"], found["rate_hz"]) == (2, 14, 5.0)
    assert found["split"] == {"train": 1, "val": 1}
    assert found["success"] == {"true": 2}
    assert found["lengths"]["pick"]["median"] == 7
    assert found["objects"] == {
        "cup": {"name": "red cup", "episodes": 2, "target": 2},
        "jar": {"name": "jar", "episodes": 2, "target": 0},
    }
    assert found["templates"] == {"pick/train/07": 2}
    assert found["relations"] == {"nearest": 1}
    assert sorted(found["instructions"].values()) == [1, 1]
    # 22 control steps, 12 of them grasp: of the states 0, 4, .. 20, 22 the first three.
    grasp, carry = found["subgoals"]["move and grasp"], found["subgoals"]["transfer object"]
    assert (grasp["count"], grasp["median"], grasp["fraction"]) == (2, 0.6, pytest.approx(3 / 7, abs=1e-6))
    assert (carry["count"], carry["median"]) == (2, 0.8)
    assert list(found["actions"]) == list(ACTION_NAMES)
    assert all(sum(part["counts"]) == part["count"] == 12 for part in found["actions"].values())
    assert found["gripper_changes"]["mean"] == 1
    (layout,) = found["layouts"].values()
    # The table's x is the world's -y, its y the world's x.
    assert np.allclose(layout["targets"], [[0.01, 0.03], [0.06, 0.03]])
    assert layout["frame"] == "table, top"
    assert np.allclose(layout["x_edges"], [0, 0.05, 0.1])
    assert np.allclose(layout["y_edges"], [-0.1, -0.05, 0, 0.05, 0.1])
    assert layout["counts"] == [[0, 2, 1, 0], [0, 0, 1, 0]]
    assert layout["coverage"] == 3 / 8


def test_statistics_of_trajectory_and_conversion_agree(made, trajectory):
    folder, file = collect_statistics(made).as_json(), collect_statistics(trajectory).as_json()
    assert (file["episodes"], file["success"]) == (3, {"true": 2, "false": 1})  # failed ones are counted
    assert file["lengths"]["pick"] == {**folder["lengths"]["pick"], "count": 3}
    assert file["objects"]["cube"] == {"name": "cube 5", "episodes": 0, "target": 3}  # the recording lists no objects
    assert file["subgoals"]["move and grasp"]["median"] == folder["subgoals"]["move and grasp"]["median"]
    assert collect_statistics(trajectory, rate_hz=10).as_json()["lengths"]["pick"]["median"] == 12


def test_far_objects_and_unknown_regions():
    at = np.array([[0.93, 0.99], [0.93, 0.94], [9.0, 9.0]])
    known = make_layout_map([ObjectPositions(at, surface=TABLE)])
    assert (known.counts.sum(), known.outside, known.coverage) == (2, 1, 2 / 8)
    heap = make_layout_map([ObjectPositions(at[:2] + [0, -0.2], surface=TABLE)])  # slid off, by less than the margin
    assert (heap.counts.sum(), heap.outside, heap.coverage) == (2, 0, 0)
    world = make_layout_map([ObjectPositions(at[:2], surface=TABLE), ObjectPositions(at[:1])])
    assert (world.frame, world.coverage, world.counts.sum()) == ("world", None, 3)
    one = make_layout_map([ObjectPositions(at[:1])])
    assert one.counts.tolist() == [[1]]


def test_histogram_and_description():
    found = compute_histogram(np.array([-2.0, 0.0, 0.0, 1.0]))
    assert (found["edges"][0], found["edges"][-1], len(found["counts"])) == (-2, 2, 41)
    assert found["counts"][20] == 2
    assert compute_histogram(np.array([0.0, 1, 1]))["counts"] == [1, 2]
    assert summarize_values([]) == {"count": 0}
    assert summarize_values([1, 2, 3, 4])["median"] == 2.5


def test_datasets_without_scenes(dataset, tmp_path):
    for path in dataset.glob("*/scene.json"):
        path.unlink()
    stats = collect_statistics(dataset)
    assert stats.summary().startswith("2 episodes (unknown 2), 14 steps")
    names = [path.name for path in write_stats(stats, tmp_path / "out")]
    assert names == ["stats.json", "lengths.png", "instructions.png", "actions.png", "subgoals.png"]


def test_images_and_json(described, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(Command(described, out=out)) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(["stats.json", *(f"{name}.png" for name in PLOTS)])
    for name in PLOTS:
        pixels = np.asarray(Image.open(out / f"{name}.png").convert("L"))
        assert (pixels < 200).mean() > 0.002, f"{name} is blank"
    line = capsys.readouterr().out.strip()
    assert "2 episodes (pick 2), 14 steps" in line
    assert "1 of 2 objects is a target" in line and "objects in 38% of the 5 cm cells" in line
    assert line.endswith(f"{out}: stats.json and 6 images")
    assert main(Command(described, json=True)) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((out / "stats.json").read_text())
    assert not (described / "preview").exists()


def test_texts_with_dollars_and_control_characters_are_labels(described, tmp_path):
    """Matplotlib parses text between two dollars as a formula."""
    stats, text = collect_statistics(described), "for $5 and \\frac{ $6\x1b[31m\nmore"
    stats.names["cup"] = text
    stats.instructions[text] += 1
    stats.lengths[text] = stats.lengths["pick"]
    stats.subgoals[text] = stats.subgoals["move and grasp"]
    names = [path.name for path in write_stats(stats, tmp_path / "out")]
    assert names == ["stats.json", *(f"{name}.png" for name in PLOTS)]


def test_the_default_folder_is_next_to_a_trajectory(trajectory, tmp_path):
    for suffix in (".h5", ".json"):
        shutil.copy(trajectory.with_suffix(suffix), tmp_path / f"T{suffix}")
    assert main(Command(tmp_path / "T.h5")) == 0
    assert (tmp_path / "T_stats/stats.json").is_file()


def test_damaged_scene(described):
    (described / "episode_0000001/scene.json").write_text('{"layout": {"object_ids": 3}}')
    with pytest.raises(DatasetError, match=r"episode_0000001/scene\.json: invalid content of scene"):
        collect_statistics(described)


@pytest.mark.parametrize(("key", "value"), [("rel_pos", np.nan), ("rel_orn", 0.0)])
def test_invalid_actions_are_refused(described, key, value):
    managing.spoil_array(described / "episode_0000001", key, value)
    with pytest.raises(DatasetError, match="episode 1"):
        collect_statistics(described)


def test_no_episodes(described):
    info = {"train_eps": [], "val_eps": [], "ep_length": {}}
    (described / "data_info.json").write_text(json.dumps(info))
    with pytest.raises(DatasetError, match="this dataset has no episodes"):
        collect_statistics(described)


def test_without_matplotlib(made, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match="plots"):
        write_stats(collect_statistics(made), tmp_path / "out")
    assert not (tmp_path / "out").exists()
