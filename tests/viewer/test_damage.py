"""Damaged datasets on the page: the row reports it, all other data is shown, nothing raises."""

import json
import shutil

import numpy as np
import pytest

from robocas_ms3.cli.view import View, main
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.viewer.episode_table import Failures
from robocas_ms3.viewer.routes import Routes, make_script
from robocas_ms3.viewer.source import open_content


def shown(source, numbers=(0, 1, 2)):
    """The index, and the status of each episode, as the server responds."""
    routes = Routes(source)
    responses = [routes.respond(f"/data/{name}.js") for name in ("index", *(f"episode_{n}" for n in numbers))]
    assert {response.status for response in responses} <= {200, 404}
    assert responses[0].status == 200
    json.dumps(routes.index)
    return routes.index, [response.status for response in responses[1:]]


def change(path, **new):
    path.write_text(json.dumps({**json.loads(path.read_text()), **new}))


@pytest.fixture
def spoilt(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "spoilt")


@pytest.mark.parametrize(
    ("new", "damage"),
    [
        ({"target": "cube"}, 'scene.json, target: expected an object, found "cube"'),
        ({"recorded": {"recoveries": [{"stage": 3}]}}, "scene.json, recorded.recoveries.0.range: expected this key"),
        ({"layout": {"poses": [5]}}, "scene.json, layout.poses.0: expected a list, found 5"),
        ({"seed": "x", "task": 3}, "scene.json, task: expected text, found 3; scene.json, seed: expected an integer"),
    ],
)
def test_row_reports_damage(spoilt, new, damage):
    change(spoilt / "episode_0000001/scene.json", **new)
    (_, row, _, _) = open_content(spoilt).index()["episodes"]
    assert row["damage"].startswith(damage)
    assert (row["object"], row["seed"], row["success"]) == ("cube 4 (cube)", 4, False)  # of the overview or the scene
    assert open_content(spoilt).episode(1)["n"] == 1


@pytest.mark.parametrize("text", ["[1]", "null", "{", "\xff"])
@pytest.mark.parametrize("name", ["episode_0000001/scene.json", "conversion.json", "data_info.json"])
def test_files_with_other_content(spoilt, name, text):
    (spoilt / name).write_bytes(text.encode("latin-1"))
    index, statuses = shown(open_content(spoilt))
    assert statuses == [200, 200, 200]
    if "/" in name:
        assert index["episodes"][1]["damage"].startswith("scene.json: ")
    else:
        assert f"`{name}` is damaged" in index["note"]


def test_missing_episode_does_not_change_the_split_of_others(spoilt):
    change(spoilt / "data_info.json", train_eps=[0, 1, 9], val_eps=[2])
    assert [row["split"] for row in open_content(spoilt).index()["episodes"]][:3] == ["train", "train", "val"]


def test_a_rate_of_zero_is_replaced_with_a_note(spoilt):
    change(spoilt / "conversion.json", rate_hz=0)
    index = open_content(spoilt).index()
    assert index["rate_hz"] == 5
    assert index["note"].startswith("`rate_hz` of `conversion.json`")


def test_damaged_arrays_are_an_error_of_their_episode_only(spoilt):
    path = spoilt / "episode_0000001/episode_info.npz"
    with np.load(path) as content:
        arrays = dict(content)
    np.savez(path, **{**arrays, "rel_pos": arrays["rel_pos"][:3]})
    (spoilt / "episode_0000000/episode_info.npz").write_bytes(b"PK\x03\x04 cut")
    (spoilt / "episode_0000000/scene.json").write_text("{")
    source = open_content(spoilt)
    index, statuses = shown(source)
    assert statuses == [404, 404, 200]
    assert index["episodes"][0]["damage"].startswith("scene.json: damaged JSON file")
    assert [row["damage"] for row in index["episodes"][1:]] == ["", "", ""]
    for number in (0, 1):
        with pytest.raises(DatasetError):
            source.episode(number)


def test_a_damaged_trajectory(run_folder, tmp_path):
    """Entries of episodes in its JSON can be wrong; the reader checks the HDF5 file."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    path = folder / "trajectory.json"
    whole = json.loads(path.read_text())

    def write(said):
        metadata = json.loads(json.dumps(whole))
        metadata["episodes"][1]["robocas"] = said
        path.write_text(json.dumps(metadata))

    said = whole["episodes"][1]["robocas"]
    write({**said, "target": "cube"})
    (_, row, *_) = shown(open_content(folder), [0, 1])[0]["episodes"]
    assert row["damage"] == 'JSON entry, target: expected an object, found "cube"'
    assert row["instruction"].startswith("grasp the cube 4")
    write({"instruction": 3, "target": said["target"]})
    (_, row, *_) = shown(open_content(folder), [0, 1])[0]["episodes"]
    assert row["damage"].startswith("JSON entry: invalid episode entry: ")
    assert (row["object"], row["seed"], row["success"], row["stages"]) == ("cube 4 (cube)", 4, False, ["grasp"])
    for spoilt in ({"episodes": 3}, {"episodes": ["x"]}, {"env_info": {"env_id": 3, "env_kwargs": 4}}, {"robocas": []}):
        path.write_text(json.dumps({**whole, **spoilt}))
        with pytest.raises(DatasetError):
            open_content(folder)


def test_a_damaged_lerobot_dataset(lerobot, tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    from robocas_ms3.datasets.lerobot import schema as theirs

    spoilt = shutil.copytree(lerobot, tmp_path / "spoilt")
    path = spoilt / theirs.SCENES_FILE
    scenes = pq.read_table(path)
    texts = scenes.column("scene").to_pylist()
    for wrong in ("[1]", "{", json.dumps({**json.loads(texts[1]), "recorded": [], "target": "x"})):
        column = pa.array([texts[0], wrong, texts[2]], pa.string())
        pq.write_table(scenes.set_column(scenes.column_names.index("scene"), "scene", column), path)
        index, statuses = shown(open_content(spoilt))
        assert [statuses[0], statuses[2]] == [200, 200]
        assert [bool(row["damage"]) for row in index["episodes"][:3]] == [False, True, False]
    path.write_bytes(b"PAR1")
    assert "`meta/robocas/episodes.parquet` is damaged" in open_content(spoilt).index()["note"]
    settings = spoilt / theirs.CONVERSION_FILE
    for text in ("{", '{"episodes": {}, "val_eps": 3}', '{"episodes": ["x", 7, {"seed": []}], "val_eps": null}'):
        settings.write_text(text)
        index, _ = shown(open_content(spoilt))
        assert [row["n"] for row in index["episodes"][:3]] == [0, 1, 2]
    (spoilt / "meta/info.json").write_text('{"codebase_version": "v3.0", "features": 3}')
    with pytest.raises(DatasetError):
        open_content(spoilt)


def test_a_static_page_of_a_damaged_dataset(spoilt, tmp_path, capsys):
    change(spoilt / "episode_0000000/scene.json", recorded="x")
    (spoilt / "episode_0000001/episode_info.npz").write_bytes(b"PK\x03\x04 cut")
    (spoilt / "episode_0000002/base_camera/rgb/0003.png").write_bytes(b"no image")
    out = tmp_path / "page"
    assert main(View(spoilt, static=out, width=32)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == [f"episode {number} is damaged" for number in range(3)]
    assert (out / "data/episode_0.js").is_file()
    assert not (out / "data/episode_1.js").exists()
    assert not (out / "images/2/base_camera/rgb/3.jpg").exists()
    assert (out / "images/2/base_camera/rgb/4.jpg").is_file()
    text = (out / "data/index.js").read_text()
    index = json.loads(text.removeprefix('robocas.put("index",').removesuffix(");\n"))
    assert [bool(row["damage"]) for row in index["episodes"]] == [True, True, True, False]


def test_control_characters_reach_the_page_as_escapes():
    texts = ["\x1b[31m\x9b\x7f", "\u202eevil\u2069\u2028", "\\u202e", "\\\u202e\u202e", "é 😀 \u0645", "two\nlines"]
    data = make_script("index", {"name": texts})
    assert data.isascii()
    read = json.loads(data[len(b'robocas.put("index",') : -len(b");\n")])
    assert read["name"] == [
        *("\\u001b[31m\\u009b\\u007f", "\\u202eevil\\u2069\\u2028"),
        *("\\u202e", "\\\\u202e\\u202e", "é 😀 \u0645", "two\nlines"),
    ]


LINE = '{"seed": 4, "attempt": 0, "stage": "grasp", "reason": "slipped", "seconds": 2}'


def test_damaged_lines_of_failures_are_omitted_with_a_note(tmp_path, spoilt):
    assert Failures.load(tmp_path) == Failures({}, "")
    wrong = ['{"seed": "x"', LINE.replace("4", '"4"'), "[]", LINE.replace('"grasp"', "null"), "\xff\x00"]
    (tmp_path / "failures.jsonl").write_bytes("\n".join([LINE, *wrong, "", LINE, LINE[:30]]).encode("latin-1"))
    read = Failures.load(tmp_path)
    assert [len(failures) for failures in read.by_seed.values()] == [2]
    assert read.note == "Damaged lines are not shown: 2, 3, 4, 5, 6, ... of `failures.jsonl`."
    with (spoilt / "failures.jsonl").open("a") as file:
        file.write('{"seed": 12, "att')
    index = open_content(spoilt).index()
    assert index["note"] == "Damaged lines are not shown: 4 of `failures.jsonl`."
    assert [row["seed"] for row in index["episodes"]] == [3, 4, 5, 9]
    (spoilt / "failures.jsonl").unlink()
    (spoilt / "failures.jsonl").mkdir()
    index = open_content(spoilt).index()
    assert (len(index["episodes"]), index["note"]) == (3, "`failures.jsonl` can't be read: Is a directory.")
