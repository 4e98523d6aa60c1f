"""The bank gives back what was made, makes what is missing, and knows what layouts depend on."""

import subprocess
import sys
from dataclasses import fields, replace
from threading import Thread

import numpy as np
import pytest

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.scenes import source
from robocas_ms3.scenes.bank import LayoutBank, layout_bank
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.fill import fill, pairs_of
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout
from robocas_ms3.scenes.table import State


def model(**changes) -> SceneModel:
    pack = load_pack("builtin")
    data = {**load_task_config("pick_table_scattered").model_dump(mode="json"), **changes}
    return SceneModel.load(load_task_config(data), pack, pack)


def assert_same(one: Layout, two: Layout) -> None:
    for field in fields(Layout):
        a, b = getattr(one, field.name), getattr(two, field.name)
        assert type(a) is type(b), field.name
        np.testing.assert_array_equal(a, b, err_msg=field.name)


def test_a_layout_is_made_once_and_comes_back_the_same(tmp_path, monkeypatch):
    scene = model()
    bank = LayoutBank(scene, tmp_path)
    assert bank.missing(pairs_of(range(3))) == [(0, 0), (1, 1), (2, 2)]
    made = bank.get(1, 1)
    assert_same(made, sample_layout(scene, 1, 1))
    monkeypatch.setattr(source, "sample_layout", None)  # making it again would fail
    assert_same(LayoutBank(scene, tmp_path).get(1, 1), made)
    assert bank.missing(pairs_of(range(3))) == [(0, 0), (2, 2)]
    assert bank.count() == 1


def test_objects_of_one_seed_and_arrangement_of_another_are_kept_apart(tmp_path):
    bank = LayoutBank(model(), tmp_path)
    assert not np.allclose(bank.get(1, 1).object_poses, bank.get(1, 2).object_poses)
    assert bank.get(1, 2).object_ids == bank.get(1, 1).object_ids
    assert bank.missing([(2, 2), (1, 2)]) == [(2, 2)]


def test_a_damaged_file_is_made_again(tmp_path, caplog):
    bank = LayoutBank(model(), tmp_path)
    made = bank.get(0, 0)
    path = bank.path(0, 0)
    path.write_bytes(path.read_bytes()[:200])
    assert_same(bank.get(0, 0), made)
    assert "damaged, made again" in caplog.text
    assert_same(LayoutBank(model(), tmp_path).get(0, 0), made)


def test_a_seed_without_a_layout_leaves_nothing_behind(tmp_path):
    bank = LayoutBank(model(target={"max_distance": 0.1}, objects={"ids": "all", "count": 2}), tmp_path)
    with pytest.raises(LayoutError):
        bank.get(0, 0)
    assert bank.count() == 0


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({"lights": {"ambient": 0.1}}, True),
        ({"description": "other words"}, True),
        ({"robot_start": "evaluation"}, True),
        ({"randomisation": {"cameras": {}, "room": ["wall"]}}, True),
        ({"randomisation": {"robot": {}}}, False),
        ({"layout": {"kind": "scattered", "min_gap": 0.02}}, False),
        ({"objects": {"ids": "all", "count": 9}}, False),
    ],
)
def test_what_layouts_depend_on_is_in_the_name(tmp_path, changes, same):
    assert (LayoutBank(model(**changes), tmp_path).folder == LayoutBank(model(), tmp_path).folder) is same


def test_no_bank_gives_the_same_layouts(tmp_path):
    scene = model()
    assert_same(layout_bank(scene, None)(2, 2), layout_bank(scene, tmp_path)(2, 2))


def test_furniture_that_is_made_anew_has_layouts_of_its_own(tmp_path):
    scene = model()
    table = scene.furniture["table"]
    top = table.asset.surfaces["top"]
    higher = table.asset.model_copy(update={"surfaces": {"top": top.model_copy(update={"z": top.z + 0.05})}})
    changed = replace(scene, furniture={"table": replace(table, asset=higher)})
    assert LayoutBank(changed, tmp_path).folder != LayoutBank(scene, tmp_path).folder


def test_several_envs_want_each_objects_with_every_seed_and_their_own():
    assert pairs_of([0, 1]) == [(0, 0), (1, 1)]
    assert pairs_of([0, 1], [1, 7]) == [(1, 1), (1, 0), (7, 7), (7, 0), (7, 1)]


def test_a_table_keeps_what_an_earlier_one_holds_and_what_is_known_of_it(tmp_path):
    bank = LayoutBank(model(), tmp_path)
    assert bank.table("cpu") is None
    for pair in ((0, 0), (0, 1), (2, 1)):
        bank.get(*pair)
    bank.write_table("cpu", [(0, 0), (0, 1)])
    bank.mark_table("cpu", {(0, 1): State.MOVES})
    bank.path(0, 0).unlink()
    table = bank.write_table("cpu", [(2, 1), (2, 9)])  # of the last there is no layout yet
    assert table is not None
    assert table.pairs() == [(0, 0), (0, 1), (2, 1)]
    assert table.pairs(State.MOVES) == [(0, 1)]
    assert table.pairs(State.UNTRIED) == [(0, 0), (2, 1)]
    assert bank.table("gpu") is None


def test_a_table_is_changed_by_one_process_at_a_time(tmp_path):
    bank, other = LayoutBank(model(), tmp_path), LayoutBank(model(), tmp_path)
    bank.get(0, 0)
    bank.get(1, 1)
    with bank._alone():
        writing = Thread(target=other.write_table, args=("cpu", [(1, 1)]))
        writing.start()
        writing.join(0.3)
        assert writing.is_alive()
    writing.join()
    table = bank.write_table("cpu", [(0, 0)])
    assert table is not None
    assert table.pairs() == [(0, 0), (1, 1)]


def test_a_damaged_table_is_none_and_said(tmp_path, caplog):
    bank = LayoutBank(model(), tmp_path)
    bank.get(0, 0)
    bank.write_table("gpu", [(0, 0)])
    path = bank.table_path("gpu")
    path.write_bytes(path.read_bytes()[:-9])
    assert bank.table("gpu") is None
    assert "no table of layouts" in caplog.text


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_objects_that_can_not_be_laid_out_are_tried_but_once(jobs, tmp_path):
    bank = LayoutBank(model(target={"max_distance": 0.1}, objects={"ids": "all", "count": 2}), tmp_path)
    problems = dict(fill(bank, pairs_of([0, 1, 2], [1]), jobs))
    assert problems.keys() == {(1, 1), (1, 0), (1, 2)}
    assert len(set(problems.values())) == 1
    assert "no object qualifies" in problems[1, 1]


def test_without_a_bank_the_objects_of_a_seed_are_looked_for_once(monkeypatch):
    asked = []
    make = sample_layout
    monkeypatch.setattr(source, "sample_layout", lambda *order: asked.append(order[1:]) or make(*order))
    layouts = layout_bank(model(), None)
    ids = layouts(1, 2).object_ids
    assert layouts(1, 3).object_ids == layouts(1, 1).object_ids == ids
    assert asked == [(1, 1, None), (1, 2, ids), (1, 3, ids), (1, 1, None)]


@pytest.mark.slow
def test_a_process_whose_physx_has_a_gpu_makes_the_same_layouts():
    program = (
        "import sys\nfrom sapien import physx\n"
        "if sys.argv[1] == 'gpu':\n    physx._enable_gpu()\n"
        "from robocas_ms3.assets.pack import load_pack\nfrom robocas_ms3.scenes.config import load_task_config\n"
        "from robocas_ms3.scenes.bank import layout_bank\nfrom robocas_ms3.scenes.model import SceneModel\n"
        "pack = load_pack('builtin')\n"
        "model = SceneModel.load(load_task_config('search_table_small_heap'), pack, pack)\n"
        "for seed in (0, 1):\n"
        "    found = layout_bank(model, None)(seed, seed)\n"
        "    sys.stdout.buffer.write(found.object_poses.tobytes() + bytes([found.target]))\n"
    )
    said = []
    for way in ("cpu", "gpu"):
        command = [sys.executable, "-c", program, way]
        done = subprocess.run(command, capture_output=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr.decode()
        said.append(done.stdout)
    assert len(said[0]) > 100
    assert said[0] == said[1]
