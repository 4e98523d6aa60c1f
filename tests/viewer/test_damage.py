"""Damaged datasets on the page: the row says what is wrong, all else is shown, nothing raises."""

import json
import shutil

import numpy as np
import pytest

from robocas_ms3.cli.view import View, main
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.viewer.routes import Routes, script
from robocas_ms3.viewer.source import open_source
from robocas_ms3.viewer.table import Failures

WRONG = ["x", 7, True, ["x"], {"x": 1}, None, [[]], {"poses": 3}, [{"slot": "x"}], 2**62]


def shown(source, numbers=(0, 1, 2)):
    """Index and episodes as the server answers."""
    routes = Routes(source)
    answers = [routes.respond(f"/data/{name}.js") for name in ("index", *(f"episode_{n}" for n in numbers))]
    assert {answer.status for answer in answers} <= {200, 404}
    assert answers[0].status == 200
    json.dumps(routes.index)
    return routes.index, [answer.status for answer in answers[1:]]


def change(path, **new):
    path.write_text(json.dumps({**json.loads(path.read_text()), **new}))


@pytest.fixture
def spoilt(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "spoilt")


@pytest.mark.parametrize("key", schema.SCENE)
def test_wrong_values_in_a_scene(spoilt, key):
    path = spoilt / "episode_0000001/scene.json"
    whole = path.read_text()
    for value in WRONG:
        path.write_text(whole)
        change(path, **{key: value})
        index, statuses = shown(open_source(spoilt), [1])
        assert statuses == [200]
        damages = [row["damage"] for row in index["episodes"]]
        assert damages[0] == damages[2] == ""
        assert damages[1] == "" or damages[1].startswith(f"scene.json, {key}")


@pytest.mark.parametrize(
    ("new", "damage"),
    [
        ({"target": "cube"}, 'scene.json, target: expected an object, found "cube"'),
        ({"recorded": "x"}, 'scene.json, recorded: expected an object, found "x"'),
        ({"recorded": {"recoveries": [{"stage": 3}]}}, "scene.json, recorded.recoveries.0.range: expected this key"),
        ({"objects": {}}, "scene.json, objects: expected a list, found {}"),
        ({"layout": {"poses": [5]}}, "scene.json, layout.poses.0: expected a list, found 5"),
        ({"seed": "x", "task": 3}, "scene.json, task: expected text, found 3; scene.json, seed: expected an integer"),
    ],
)
def test_the_row_says_what_is_wrong(spoilt, new, damage):
    change(spoilt / "episode_0000001/scene.json", **new)
    (_, row, _, _) = open_source(spoilt).index()["episodes"]
    assert row["damage"].startswith(damage)
    assert (row["object"], row["seed"], row["success"]) == ("cube 4 (cube)", 4, False)  # of the ledger or the scene
    assert open_source(spoilt).episode(1)["n"] == 1


@pytest.mark.parametrize(
    "text", ["[1]", "null", "7", "{", "", '"x"', "\xff", "[" * 100_000, '{"a": NaN}'], ids=lambda t: t[:5]
)
@pytest.mark.parametrize("name", ["episode_0000001/scene.json", "conversion.json", "data_info.json"])
def test_files_that_hold_something_else(spoilt, name, text):
    (spoilt / name).write_bytes(text.encode("latin-1"))
    index, statuses = shown(open_source(spoilt))
    assert statuses == [200, 200, 200]
    if "/" in name:
        assert index["episodes"][1]["damage"].startswith("scene.json: ")
    else:
        assert f"`{name}` is damaged" in index["note"]


@pytest.mark.parametrize("name", ["conversion.json", "data_info.json"])
def test_wrong_values_in_the_overviews(spoilt, name):
    path = spoilt / name
    whole = path.read_text()
    for key in json.loads(whole):
        for value in (*WRONG, {"1": "x"}, {"1": []}, {"1": None}, {"1": {"seed": "x", "target": 3}}):
            path.write_text(whole)
            change(path, **{key: value})
            assert shown(open_source(spoilt), [1])[1] == [200]


def test_a_rate_that_is_none_is_said(spoilt):
    change(spoilt / "conversion.json", rate_hz=0)
    index = open_source(spoilt).index()
    assert index["rate_hz"] == 5
    assert index["note"] == ("`rate_hz` of `conversion.json`: expected greater than 0, found 0; 5 Hz is assumed.")


def test_arrays_that_contradict_each_other(spoilt):
    path = spoilt / "episode_0000001/episode_info.npz"
    with np.load(path) as content:
        arrays = dict(content)
    np.savez(path, **{**arrays, "rel_pos": arrays["rel_pos"][:3]})
    with pytest.raises(DatasetError, match="different lengths"):
        open_source(spoilt).episode(1)
    assert shown(open_source(spoilt))[1] == [200, 404, 200]


def test_a_damaged_trajectory(run_folder, tmp_path):
    """Of its JSON, entries of episodes can be wrong; of HDF5 the reader sees to it."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    path = folder / "trajectory.json"
    whole = json.loads(path.read_text())
    for key in ("instruction", "target", "attempts", "recoveries", "facts", "objects", "relation", None):
        for value in WRONG:
            metadata = json.loads(json.dumps(whole))
            entry = metadata["episodes"][1]
            if key is None:
                entry["robocas"] = value
            else:
                entry["robocas"][key] = value
            path.write_text(json.dumps(metadata))
            index, statuses = shown(open_source(folder), [0, 1])
            assert statuses[0] == 200
            assert [bool(row["damage"]) for row in index["episodes"]][::2] == [False, False]
    metadata = json.loads(json.dumps(whole))
    metadata["episodes"][1]["robocas"]["target"] = "cube"
    path.write_text(json.dumps(metadata))
    (_, row, *_) = open_source(folder).index()["episodes"]
    assert row["damage"] == 'its entry of the JSON, target: expected an object, found "cube"'
    assert row["instruction"].startswith("grasp the cube 4")
    metadata["episodes"][1]["robocas"] = {"instruction": 3, "target": whole["episodes"][1]["robocas"]["target"]}
    path.write_text(json.dumps(metadata))
    (_, row, *_) = open_source(folder).index()["episodes"]
    assert row["damage"].startswith("its entry of the JSON: the JSON's entry: ")
    assert (row["object"], row["seed"], row["success"], row["stages"]) == ("cube 4 (cube)", 4, False, ["grasp"])
    for spoilt in ({"episodes": 3}, {"episodes": ["x"]}, {"env_info": {"env_id": 3, "env_kwargs": 4}}, {"robocas": []}):
        path.write_text(json.dumps({**whole, **spoilt}))
        with pytest.raises(DatasetError):
            open_source(folder)


def test_a_damaged_lerobot_dataset(lerobot, tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    from robocas_ms3.datasets.lerobot import schema as theirs

    spoilt = shutil.copytree(lerobot, tmp_path / "spoilt")
    path = spoilt / theirs.SCENES_FILE
    scenes = pq.read_table(path)
    texts = scenes.column("scene").to_pylist()
    for wrong in ("[1]", "null", "{", '"x"', json.dumps({**json.loads(texts[1]), "recorded": [], "target": "x"})):
        column = pa.array([texts[0], wrong, texts[2]], pa.string())
        pq.write_table(scenes.set_column(scenes.column_names.index("scene"), "scene", column), path)
        index, statuses = shown(open_source(spoilt))
        assert [statuses[0], statuses[2]] == [200, 200]
        damages = [row["damage"] for row in index["episodes"][:3]]
        assert (damages[0], bool(damages[1]), damages[2]) == ("", True, "")
    path.write_bytes(b"PAR1")
    assert "`meta/robocas/episodes.parquet` is damaged" in open_source(spoilt).index()["note"]
    settings = spoilt / theirs.CONVERSION_FILE
    for text in ("[1]", "{", '{"episodes": {}, "val_eps": 3}', '{"episodes": ["x", 7, {"seed": []}], "val_eps": null}'):
        settings.write_text(text)
        index = open_source(spoilt).index()
        assert [row["n"] for row in index["episodes"][:3]] == [0, 1, 2]
        json.dumps(index)
    (spoilt / "meta/info.json").write_text('{"codebase_version": "v3.0", "features": 3}')
    with pytest.raises(DatasetError):
        open_source(spoilt)


def test_a_static_page_of_a_damaged_dataset(spoilt, tmp_path, capsys):
    change(spoilt / "episode_0000000/scene.json", recorded="x")
    (spoilt / "episode_0000001/episode_info.npz").write_bytes(b"PK\x03\x04 cut")
    (spoilt / "episode_0000002/base_camera/rgb/0003.png").write_bytes(b"no picture")
    out = tmp_path / "page"
    assert main(View(spoilt, static=out, width=32)) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == 'episode 0 is damaged: scene.json, recorded: expected an object, found "x"'
    assert said[1].startswith("episode 1 is damaged: ")
    assert said[2].startswith("episode 2 is damaged: pictures: ")
    assert (out / "data/episode_0.js").is_file()
    assert not (out / "data/episode_1.js").exists()
    assert not (out / "pictures/2/base_camera/rgb/3.jpg").exists()
    assert (out / "pictures/2/base_camera/rgb/4.jpg").is_file()
    text = (out / "data/index.js").read_text()
    index = json.loads(text.removeprefix('robocas.put("index",').removesuffix(");\n"))
    assert [bool(row["damage"]) for row in index["episodes"]] == [True, True, True, False]


def test_control_characters_reach_the_page_as_escapes():
    texts = ["\x1b[31m\x9b\x7f", "\u202eevil\u2069\u2028", "\\u202e", "\\\u202e\u202e", "é 😀 \u0645", "two\nlines"]
    data = script("index", {"name": texts, "number": float("nan")})
    assert data.isascii()
    shown = json.loads(data[len(b'robocas.put("index",') : -len(b");\n")])
    assert shown["name"] == [
        *("\\u001b[31m\\u009b\\u007f", "\\u202eevil\\u2069\\u2028"),
        *("\\u202e", "\\\\u202e\\u202e", "é 😀 \u0645", "two\nlines"),
    ]


def test_numbers_that_json_does_not_know():
    assert (
        script("x", {"a": [1.5, float("nan"), (float("inf"), "NaN")]})
        == b'robocas.put("x",{"a":[1.5,null,[null,"NaN"]]});\n'
    )


LINE = '{"seed": 4, "attempt": 0, "stage": "grasp", "reason": "slipped", "seconds": 2}'


def test_no_failures_are_no_failures(tmp_path):
    assert Failures.read(tmp_path) == Failures({}, "")
    (tmp_path / "failures.jsonl").write_text("")
    assert Failures.read(tmp_path) == Failures({}, "")


def test_a_damaged_line_is_named_and_the_others_are_read(tmp_path):
    wrong = ['{"seed": "x"', LINE.replace("4", '"4"'), "[]", LINE.replace('"grasp"', "null"), "\xff\x00"]
    (tmp_path / "failures.jsonl").write_bytes("\n".join([LINE, *wrong, "", LINE, LINE[:30]]).encode("latin-1"))
    read = Failures.read(tmp_path)
    assert [len(failures) for failures in read.by_seed.values()] == [2]
    assert read.note == "6 lines of `failures.jsonl` are damaged and left out: 2, 3, 4, 5, 6, ..."


def test_a_damaged_line_is_named_on_the_page(spoilt):
    with (spoilt / "failures.jsonl").open("a") as file:
        file.write('{"seed": 12, "att')
    index = open_source(spoilt).index()
    assert index["note"] == "Line 4 of `failures.jsonl` is damaged and left out."
    assert [row["seed"] for row in index["episodes"]] == [3, 4, 5, 9]


def test_failures_that_can_not_be_read(spoilt):
    (spoilt / "failures.jsonl").unlink()
    assert len(open_source(spoilt).index()["episodes"]) == 3
    (spoilt / "failures.jsonl").mkdir()
    index = open_source(spoilt).index()
    assert index["note"] == "`failures.jsonl` can't be read: Is a directory."
    assert len(index["episodes"]) == 3
