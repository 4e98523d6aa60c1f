import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import planar
from robocas_ms3.scenes import placement
from robocas_ms3.scenes.placement import PlaceableObject, Region, choose_objects, sample_scattered


def box(width: float, depth: float, height: float = 0.1) -> PlaceableObject:
    """A box that stands or lies on its side."""
    standing, lying = np.eye(4), np.eye(4)
    standing[2, 3], lying[2, 3] = height / 2, depth / 2
    lying[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]

    def outline(a, b):
        return np.array([[-a, -b], [a, -b], [a, b], [-a, b]]) / 2

    return PlaceableObject(
        "box", np.stack([standing, lying]), np.array([0.5, 0.5]), [outline(width, depth), outline(width, height)]
    )


def test_planar_pose_turns_then_shifts():
    assert planar(1, 2, 3, np.pi / 2) @ [1, 0, 0, 1] == pytest.approx([1, 3, 3, 1])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 8))
def test_scattered_objects_keep_their_distance_and_stay_inside(seed, count):
    region = Region((0.0, -0.4), (0.4, 0.4), 0.61)
    placeables = [box(0.05 + 0.01 * i, 0.06) for i in range(count)]
    poses = sample_scattered(np.random.default_rng(seed), placeables, region, min_gap=0.02, max_tries=5000)
    outlines = []
    for pose, placeable in zip(poses, placeables, strict=True):
        half = np.array([placeable.footprints[0][1, 0], placeable.footprints[0][2, 1], 0.05])
        corners = np.array([[sx, sy, sz] for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)]) * half
        world = corners @ pose[:3, :3].T + pose[:3, 3]
        assert world[:, 2].min() == pytest.approx(0.61)
        assert (world[:, :2] >= np.array(region.min_xy) - 1e-9).all()
        assert (world[:, :2] <= np.array(region.max_xy) + 1e-9).all()
        outlines.append(shapely.MultiPoint(world[:, :2]).convex_hull)
    for i, a in enumerate(outlines):
        for b in outlines[:i]:
            assert a.distance(b) >= 0.02 - 1e-9


def test_scattered_repeats_for_the_same_seed_only():
    region = Region((0.0, 0.0), (0.5, 0.5), 0.0)
    first, again, other = (
        sample_scattered(np.random.default_rng(seed), [box(0.1, 0.05)] * 3, region, min_gap=0.01, max_tries=500)
        for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_objects_that_do_not_fit_are_an_error_with_the_fix():
    with pytest.raises(LayoutError, match=r"no room for 10 objects 2.0 cm apart on 0.20 x 0.20 m.*Lower objects.count"):
        sample_scattered(
            np.random.default_rng(0), [box(0.1, 0.1)] * 10, Region((0, 0), (0.2, 0.2), 0), min_gap=0.02, max_tries=300
        )


def test_objects_repeat_only_when_there_are_too_few():
    rng = np.random.default_rng(0)
    assert sorted(choose_objects(rng, ["a", "b", "c"], 3)) == ["a", "b", "c"]
    assert sorted(choose_objects(rng, ["a", "b"], 5)).count("a") in (2, 3)
    counts = {choose_objects(rng, ["a", "b"], 4, repeats=True).count("a") for _ in range(100)}
    assert counts == {0, 1, 2, 3, 4}


def test_where_it_is_tight_objects_are_packed(monkeypatch):
    """Eleven discs of 9 cm, 1 cm apart, on 43 x 33 cm: in rows they fit (twelve would), strewn at random they don't."""
    angles = np.arange(24) * np.pi / 12
    disc = 0.045 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    things = [PlaceableObject(f"disc_{i}", np.eye(4)[None], np.ones(1), [disc]) for i in range(11)]
    region = Region((0.0, 0.0), (0.43, 0.33), 0.0)

    def layout():
        return sample_scattered(np.random.default_rng(0), things, region, min_gap=0.01, max_tries=40_000)

    poses = layout()
    apart = np.linalg.norm(poses[:, None, :2, 3] - poses[None, :, :2, 3], axis=2)[np.triu_indices(11, 1)]
    assert apart.min() >= 0.1 - 1e-3  # polygons of 24 corners are up to 0.4 mm thinner than discs
    monkeypatch.setattr(placement, "_TIGHT", 2.0)
    with pytest.raises(LayoutError):
        layout()
