"""The layout cache returns stored layouts, samples missing ones, and depends on everything that affects layouts."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
from dataclasses import fields, replace

import numpy as np
import psutil
import pytest
from sapien import physx
from scene_models import load_scene

from robocas_ms3.core.errors import SimulationError
from robocas_ms3.scenes import cache as cache_module
from robocas_ms3.scenes.cache import LayoutCache, LayoutSampler, count_layouts, make_layout_source, seed_pairs
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.layout_table import LayoutStatus
from robocas_ms3.scenes.sample import sample_layout

NO_TARGET = {"target": {"max_distance": 0.1}, "objects": {"ids": "all", "count": 2}}


def assert_same(one: Layout, two: Layout) -> None:
    for field in fields(Layout):
        a, b = getattr(one, field.name), getattr(two, field.name)
        assert type(a) is type(b), field.name
        np.testing.assert_array_equal(a, b, err_msg=field.name)


def test_layout_is_sampled_once_and_read_back_unchanged(tmp_path, monkeypatch):
    scene = load_scene()
    made = LayoutCache(scene, tmp_path).get(1, 1)
    assert_same(made, sample_layout(scene, 1, 1))
    assert_same(make_layout_source(scene, None)(1, 1), made)
    monkeypatch.setattr(cache_module, "sample_layout", None)  # sampling again would fail
    cache = LayoutCache(scene, tmp_path)
    assert_same(cache.get(1, 1), made)
    assert cache.missing_pairs(seed_pairs(range(3))) == [(0, 0), (2, 2)]
    assert count_layouts(cache.folder) == 1


def test_layouts_of_different_objects_seeds_have_different_files(tmp_path):
    cache = LayoutCache(load_scene(), tmp_path)
    assert not np.allclose(cache.get(1, 1).object_poses, cache.get(1, 2).object_poses)
    assert cache.get(1, 2).object_ids == cache.get(1, 1).object_ids
    assert cache.missing_pairs([(2, 2), (1, 2)]) == [(2, 2)]


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
def test_folder_name_depends_on_everything_that_affects_layouts(tmp_path, changes, same):
    assert (LayoutCache(load_scene(**changes), tmp_path).folder == LayoutCache(load_scene(), tmp_path).folder) is same


def test_changed_furniture_has_its_own_cache(tmp_path):
    scene = load_scene()
    table = scene.furniture["table"]
    top = table.asset.surfaces["top"]
    higher = table.asset.model_copy(update={"surfaces": {"top": top.model_copy(update={"z": top.z + 0.05})}})
    changed = replace(scene, furniture={"table": replace(table, asset=higher)})
    assert LayoutCache(changed, tmp_path).folder != LayoutCache(scene, tmp_path).folder


def test_table_keeps_layouts_and_statuses_of_an_earlier_table(tmp_path):
    cache = LayoutCache(load_scene(), tmp_path)
    assert cache.load_table("cpu") is None
    for pair in ((0, 0), (0, 1), (2, 1)):
        cache.get(*pair)
    cache.write_table("cpu", [(0, 0), (0, 1)])
    cache.write_statuses("cpu", {(0, 1): LayoutStatus.UNSTABLE})
    cache.layout_path(0, 0).unlink()
    table = cache.write_table("cpu", [(2, 1), (2, 9)])  # the last pair has no layout yet
    assert table is not None
    assert table.find_pairs() == [(0, 0), (0, 1), (2, 1)]
    assert table.find_pairs(LayoutStatus.UNSTABLE) == [(0, 1)]
    assert table.find_pairs(LayoutStatus.UNCHECKED) == [(0, 0), (2, 1)]
    path = cache.table_path("cpu")
    path.write_bytes(path.read_bytes()[:-9])
    assert cache.load_table("cpu") is None  # damaged
    assert cache.load_table("gpu") is None


def test_table_is_written_by_one_process_at_a_time(tmp_path):
    cache, other = LayoutCache(load_scene(), tmp_path), LayoutCache(load_scene(), tmp_path)
    cache.get(0, 0)
    cache.get(1, 1)
    with cache._locked():
        writing = threading.Thread(target=other.write_table, args=("cpu", [(1, 1)]))
        writing.start()
        writing.join(0.3)
        assert writing.is_alive()
    writing.join()
    table = cache.write_table("cpu", [(0, 0)])
    assert table is not None
    assert table.find_pairs() == [(0, 0), (1, 1)]


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_objects_without_layout_are_tried_once_and_leave_no_files(jobs, tmp_path):
    cache = LayoutCache(load_scene(**NO_TARGET), tmp_path)
    problems = dict(cache.fill(seed_pairs([0, 1, 2], [1]), jobs))
    assert problems.keys() == {(1, 1), (1, 0), (1, 2)}
    assert len(set(problems.values())) == 1
    assert "no object qualifies" in problems[1, 1]
    assert count_layouts(cache.folder) == 0


# ------------------------------------------------------------- where PhysX has a GPU, a worker process samples


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.setattr(physx, "is_gpu_enabled", lambda: True)


def test_sampling_worker_gives_equal_layouts_is_replaced_and_ends_with_the_sampler(gpu):
    scene, before = load_scene(), psutil.Process().children()
    sampler = LayoutSampler(scene)

    def worker() -> psutil.Process:
        (process,) = [child for child in psutil.Process().children() if child not in before]
        return process

    for seed in (3, 4):
        np.testing.assert_array_equal(sampler(3, seed).object_poses, sample_layout(scene, 3, seed).object_poses)
    worker().kill()
    np.testing.assert_array_equal(sampler(1, 1).object_poses, sample_layout(scene, 1, 1).object_poses)
    process = worker()
    del sampler
    gc.collect()
    assert psutil.wait_procs([process], timeout=30)[0] == [process]


class KillingIds:
    """Object ids that kill the process that unpickles them (stands for a crash of PhysX)."""

    def __reduce__(self):
        return kill_this_process, ()


def kill_this_process():
    os.kill(os.getpid(), signal.SIGSEGV)


def test_process_that_crashes_twice_is_no_missing_layout(gpu):
    with pytest.raises(SimulationError) as caught:
        LayoutSampler(load_scene()).sample(0, 1, KillingIds())  # pyright: ignore[reportArgumentType]
    assert (caught.value.where, caught.value.found) == ("seed 1", "SIGSEGV")


@pytest.mark.slow
def test_process_with_physx_on_a_gpu_makes_equal_layouts():
    program = (
        "import sys\nfrom sapien import physx\n"
        "if sys.argv[1] == 'gpu':\n    physx._enable_gpu()\n"
        "from robocas_ms3.assets.pack import load_pack\nfrom robocas_ms3.scenes.config import load_task_config\n"
        "from robocas_ms3.scenes.cache import make_layout_source\nfrom robocas_ms3.scenes.model import SceneModel\n"
        "pack = load_pack('builtin')\n"
        "model = SceneModel.load(load_task_config('search_table_small_heap'), pack, pack)\n"
        "for seed in (0, 1):\n"
        "    found = make_layout_source(model, None)(seed, seed)\n"
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


def test_seed_pairs_of_each_objects_seed():
    assert seed_pairs([0, 1]) == [(0, 0), (1, 1)]
    assert seed_pairs([0, 1], [1, 7]) == [(1, 1), (1, 0), (7, 7), (7, 0), (7, 1)]
