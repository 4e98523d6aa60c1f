"""Heaps of bundled objects: on the plane, inside the region, occluding each other, and reproducible."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import transform_points
from robocas_ms3.scenes import heap
from robocas_ms3.scenes.config.task import StackedLayout
from robocas_ms3.scenes.heap import SPREAD, drop_heap
from robocas_ms3.scenes.placement import Region
from robocas_ms3.scenes.visibility import MeshScene, load_visual_mesh, top_down_camera

REGION = Region((-0.05, -0.25), (0.25, 0.15), 0.61)


LAYOUT = StackedLayout(kind="stacked")
# Origins of three objects of each of three seeds, m, recorded before the layout had keys for walls, order and time
BEFORE = {
    0: [[0.16646, -0.0009616, 0.6232153], [0.1101041, -0.1502432, 0.6489264], [0.1065183, -0.0054217, 0.6447076]],
    1: [[0.1871869, 0.0199118, 0.7035184], [0.0779445, -0.0612329, 0.6347642], [0.1049845, 0.0871008, 0.6446248]],
    2: [[0.0108729, -0.0588102, 0.6356797], [0.0771046, -0.0800256, 0.6525802], [0.1425298, -0.0094603, 0.6278589]],
}


def make_heap(seed: int, count: int = 12, **keys):
    pack = load_pack("builtin")
    rng = np.random.default_rng(seed)
    assets = [pack.objects[i] for i in rng.choice(sorted(pack.objects), count, replace=False)]
    return assets, drop_heap(rng, assets, REGION, StackedLayout(kind="stacked", **keys))


@pytest.mark.slow
def test_objects_rest_on_the_plane_and_on_each_other():
    on_others = []
    for seed in range(3):
        assets, poses = make_heap(seed)
        low = np.array(
            [transform_points(p, np.concatenate(a.hulls))[:, 2].min() for a, p in zip(assets, poses, strict=True)]
        )
        assert low.min() > REGION.z - 0.002  # no object penetrates the plane
        on_others.append((low > REGION.z + 0.01).sum())
        for asset, pose in zip(assets, poses, strict=True):
            center = transform_points(pose, np.array([asset.asset.center_of_mass]))[0, :2]
            assert (center >= np.array(REGION.min_xy) - SPREAD).all()
            assert (center <= np.array(REGION.max_xy) + SPREAD).all()
        camera = top_down_camera(np.array([0.1, -0.05]), REGION.z, size=128)
        shares = MeshScene([load_visual_mesh(a) for a in assets], poses).visible_fractions(camera)
        assert (shares < 0.9).sum() >= 2  # some objects are hidden
    assert sum(on_others) >= len(on_others)


def test_heap_over_the_edges_is_an_error():
    pack = load_pack("builtin")
    with pytest.raises(LayoutError, match="a heap of 2 objects does not fit"):
        tiny = Region((0.0, 0.0), (0.001, 0.001), 0.0)
        assets = [pack.objects["power_drill"], pack.objects["sugar_box"]]
        drop_heap(np.random.default_rng(0), assets, tiny, LAYOUT)


def test_order_noise_decides_which_objects_fall_first():
    assets = [load_pack("builtin").objects[i] for i in ("power_drill", "soap", "padlock")]

    def firsts(noise):
        found = [int(heap.draw_drop_order(np.random.default_rng(s), assets, noise)[0]) for s in range(300)]
        return np.bincount(found, minlength=3) / 300

    shares = firsts(0.5)
    assert shares[2] > 0.6 and shares[1] > 0.02 and shares[0] < 0.02
    assert heap.draw_drop_order(np.random.default_rng(0), assets, 0.0).tolist() == [2, 1, 0]
    assert firsts(None).min() > 0.23


@pytest.mark.parametrize("seed", BEFORE)
def test_default_heaps_are_unchanged(seed):
    np.testing.assert_allclose(make_heap(seed, 3)[1][:, :3, 3], BEFORE[seed], atol=1e-6)


def test_objects_fall_into_the_middle_of_the_bucket_or_all_over_it():
    assets = [load_pack("builtin").objects["rubiks_cube"]]
    keys = {"tumble_probability": 0.0, "bucket": 1.0}

    def places(**more):
        layout = StackedLayout(kind="stacked", **keys, **more)
        return np.array([drop_heap(np.random.default_rng(s), assets, REGION, layout)[0, :2, 3] for s in range(6)])

    np.testing.assert_allclose(places(drop_spread=0.0), np.tile([0.1, -0.05], (6, 1)), atol=2e-3)
    low, high = np.array(REGION.min_xy), np.array(REGION.max_xy)
    strewn = places()
    assert (np.ptp(strewn, axis=0) > 0.3 * (high - low)).all()
    assert (strewn > low + 0.02).all() and (strewn < high - 0.02).all()  # clear of the walls


def test_outline_approximates_the_convex_hull():
    assets = load_pack("builtin").objects
    for name in ("sugar_box", "mug", "apple"):
        points, outline = np.concatenate(assets[name].hulls), heap.outline_points(assets[name])
        assert len(outline) <= 64
        planes = ConvexHull(outline).equations
        depth = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        assert depth.max() < 0.002  # nothing of the object stands out of it farther than that
