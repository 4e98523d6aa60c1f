"""What stays, what falls, and that the same comes out each time."""

import numpy as np
import pytest

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.poses import planar
from robocas_ms3.scenes import settle as settle_module
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.settle import settle


@pytest.fixture(scope="module")
def model() -> SceneModel:
    pack = load_pack("builtin")
    return SceneModel.load(load_task_config("pick_table_scattered"), pack, pack)


def on_table(model, name: str, x: float, y: float, lift: float = 0.0) -> np.ndarray:
    notes = model.object_pack.objects[name].annotations
    stands = notes.resting_poses[max(notes.display_pose, 0)]
    return planar(x, y, 0.61 + lift, 0.3) @ stands


def run(model, names, poses):
    return settle([model.object_pack.objects[n] for n in names], np.stack(poses), model, model.basket_pose)


def test_objects_in_resting_poses_stay(model):
    names = ["sugar_box", "mug"]
    poses = [on_table(model, "sugar_box", 0.9, 0.9), on_table(model, "mug", 1.0, 1.1)]
    settled = run(model, names, poses)
    assert settled.stable
    assert np.abs(settled.poses - poses).max() < 0.003


def test_an_object_that_is_dropped_settles_first(model):
    settled = run(model, ["sugar_box"], [on_table(model, "sugar_box", 0.9, 0.9, lift=0.02)])
    assert settled.stable
    assert settled.poses[0, 2, 3] == pytest.approx(on_table(model, "sugar_box", 0.9, 0.9)[2, 3], abs=0.002)


def test_an_object_beside_the_table_does_not_stay(model):
    settled = run(model, ["sugar_box"], [on_table(model, "sugar_box", 0.9, 2.5)])
    assert not settled.stable
    assert settled.shift[0] > 1


def test_the_same_comes_out_bit_for_bit(model):
    poses = [on_table(model, "mug", 0.9, 0.9, lift=0.05), on_table(model, "mug", 0.92, 0.91, lift=0.2)]
    one, two = (run(model, ["mug", "mug"], poses) for _ in range(2))
    np.testing.assert_array_equal(one.poses, two.poses)


def test_an_object_that_comes_to_rest_elsewhere_did_not_stay(model):
    settled = run(model, ["sugar_box"], [on_table(model, "sugar_box", 0.9, 0.9, lift=0.08)])
    assert settled.moved[0] == pytest.approx(0.08, abs=0.005)
    assert settled.at_rest.all() and settled.shift[0] < 0.001
    assert not settled.stable


def test_an_object_that_tips_over_did_not_stay(model):
    pose = on_table(model, "drink", 0.9, 0.9)
    lean = np.eye(4)
    lean[:3, :3] = [[np.cos(0.5), 0, np.sin(0.5)], [0, 1, 0], [-np.sin(0.5), 0, np.cos(0.5)]]
    leaning = pose.copy()
    leaning[:3, :3] = lean[:3, :3] @ pose[:3, :3]
    settled = run(model, ["drink"], [leaning])
    assert settled.tilted[0] > 0.1
    assert not settled.stable


@pytest.mark.parametrize("heap", [False, True])
def test_what_tips_in_a_heap_and_stays_is_as_put(model, monkeypatch, heap):
    tipped = planar(0, 0, 0, 0)[None]
    tipped[0, 1:3, 1:3] = [[0.8, -0.6], [0.6, 0.8]]  # by 37 deg
    monkeypatch.setattr(settle_module, "_simulate", lambda *args, **how: (tipped, np.zeros(1), np.zeros(1)))
    mug = [model.object_pack.objects["mug"]]
    settled = settle(mug, np.eye(4)[None], model, model.basket_pose, heap=heap)
    assert settled.tilted[0] == pytest.approx(np.arccos(0.8))
    assert settled.stable == heap


def test_what_moves_in_a_check_is_checked_again_from_where_it_came_to(model, monkeypatch):
    start = planar(0, 0, 0, 0)[None]
    places = iter([0.0, 0.01, 0.012, 0.0])  # x, m, at the end of each simulation

    def simulate(assets, poses, *args, **how):
        pose = start.copy()
        pose[:, 0, 3] = next(places)
        return pose, np.zeros(1), np.zeros(1)

    monkeypatch.setattr(settle_module, "_simulate", simulate)
    settled = settle([model.object_pack.objects["mug"]], start, model, model.basket_pose)
    assert settled.stable
    assert settled.poses[0, 0, 3] == 0.01 and settled.shift[0] == pytest.approx(0.002)
    assert next(places) == 0.0  # two checks were enough
