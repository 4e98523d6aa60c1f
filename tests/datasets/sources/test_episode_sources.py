"""Common interface of the sources of all formats, and damaged episodes."""

import json
import pickle
import shutil

import pytest
from synthetic import RayCaster, write_trajectory

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")

import pyarrow.parquet as pq

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.sources.trajectory import TrajectorySource


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Three episodes as trajectory, RoboCAS folder and LeRobot folder."""
    root = tmp_path_factory.mktemp("sources")
    trajectory = write_trajectory(root / "trajectory.h5", seeds=(1, 2, 3))
    convert(ConversionSettings(trajectory, root / "folder", embeddings=False, video=False, open_renderer=RayCaster))
    convert_lerobot(ConversionSettings(root / "folder", root / "lerobot"))
    return {"trajectory": trajectory, "robocas": root / "folder", "lerobot": root / "lerobot"}


@pytest.mark.parametrize("name", ["trajectory", "robocas", "lerobot"])
def test_instruction_and_length_of_an_episode(paths, name):
    source = open_source(paths[name])
    for number in source.numbers:
        episode = source.episode(number)
        said = episode.read(["language_goal", "episode_length"])
        assert (
            episode.instruction
            == said["language_goal"]
            == f"grasp the cube {number + 1} on the table and move it to the basket"
        )
        assert episode.steps == said["episode_length"] == source.lengths[number] == 7


def test_instruction_without_an_overview(paths, tmp_path):
    bare = shutil.copytree(paths["robocas"], tmp_path / "bare")
    info = json.loads((bare / "data_info.json").read_text())
    (bare / "data_info.json").write_text(json.dumps({**info, "language_goal": {"0": 3}}))
    assert open_source(bare).episode(0).instruction.startswith("grasp the cube 1")


def test_damaged_entry_of_a_trajectory_is_an_error_of_its_episode(paths, tmp_path):
    path = tmp_path / "trajectory.h5"
    shutil.copy(paths["trajectory"], path)
    content = json.loads(paths["trajectory"].with_suffix(".json").read_text())
    content["episodes"][1]["robocas"]["subgoals"] = 3
    path.with_suffix(".json").write_text(json.dumps(content))
    source = TrajectorySource(path)
    assert source.numbers == [0, 1, 2]
    assert source.episode(2).steps == 7
    for read in (lambda: source.episode(1).scene, lambda: source.lengths, lambda: source.split("train")):
        with pytest.raises(DatasetError, match=r"traj_1: invalid episode entry: "):
            read()


def test_recordings_have_every_control_step(paths):
    source = TrajectorySource(paths["trajectory"])
    recording = source.episode(0).recording()
    assert len(recording.actions) == source.episode_entry(0).control_steps > source.lengths[0]
    assert set(recording.states) == {"actors", "articulations"}


def test_a_pickled_source_reads_what_its_original_reads(paths):
    source = pickle.loads(pickle.dumps(open_source(paths["trajectory"])))
    assert [source.conversion_entry(number)["seed"] for number in source.numbers] == [1, 2, 3]
    for number in source.numbers:
        episode = source.episode(number)
        assert len(episode.arrays["ee_pos"]) == episode.steps == 7
        assert len(episode.layout["object_ids"]) == len(episode.layout["poses"])


def test_lerobot_episodes_are_found_by_number(paths, tmp_path):
    """Not by position: other datasets may lack some numbers."""
    other = shutil.copytree(paths["lerobot"], tmp_path / "other")
    (rows,) = (other / "meta/episodes").rglob("*.parquet")
    pq.write_table(pq.read_table(rows).slice(1), rows)
    source = open_source(other)
    assert source.numbers == [1, 2]
    assert source.episode(1).scene["seed"] == 2
    assert source.episode(2).read(["language_goal"])["language_goal"].item().startswith("grasp the cube 3")
    with pytest.raises(DatasetError, match="no such episode"):
        source.episode(0)
