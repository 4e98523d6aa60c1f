"""Scattered and orderly placement: positions computed by hand, and general laws."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.scenes import placement
from robocas_ms3.scenes.config.task import OrderlyLayout, ScatteredLayout
from robocas_ms3.scenes.placement import PlaceableObject, Region, draw_object_ids, sample_orderly, sample_scattered

REGION = Region((0.0, -0.4), (0.3, 0.4), 0.6)


def outline(a: float, b: float) -> np.ndarray:
    return np.array([[-a, -b], [a, -b], [a, b], [-a, b]]) / 2


def box(width: float, depth: float, height: float = 0.1) -> PlaceableObject:
    """Return a box that stands or lies on its side."""
    standing, lying = np.eye(4), np.eye(4)
    standing[2, 3], lying[2, 3] = height / 2, depth / 2
    lying[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    outlines = [outline(width, depth), outline(width, height)]
    return PlaceableObject("box", np.stack([standing, lying]), np.array([0.5, 0.5]), outlines)


def scatter(things, region, seed=0, min_gap=0.02, max_tries=5000):
    layout = ScatteredLayout(kind="scattered", min_gap=min_gap, max_tries=max_tries)
    return sample_scattered(np.random.default_rng(seed), things, region, layout)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 8))
def test_scattered_objects_keep_their_distance_and_stay_inside(seed, count):
    region = Region((0.0, -0.4), (0.4, 0.4), 0.61)
    placeables = [box(0.05 + 0.01 * i, 0.06) for i in range(count)]
    poses = scatter(placeables, region, seed)
    assert np.array_equal(poses, scatter(placeables, region, seed))
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


def test_objects_that_do_not_fit_are_an_error_with_the_fix():
    with pytest.raises(
        LayoutError, match=r"10 objects, 2.0 cm apart, do not fit on 0.20 x 0.20 m.*Lower objects.count"
    ):
        scatter([box(0.1, 0.1)] * 10, Region((0, 0), (0.2, 0.2), 0), max_tries=300)


def test_objects_are_packed_if_space_is_short(monkeypatch):
    """Eleven discs of 9 cm, 1 cm apart, fit on 43 x 33 cm in rows (twelve would), but not at random positions."""
    angles = np.arange(24) * np.pi / 12
    disc = 0.045 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    things = [PlaceableObject(f"disc_{i}", np.eye(4)[None], np.ones(1), [disc]) for i in range(11)]
    region = Region((0.0, 0.0), (0.43, 0.33), 0.0)
    poses = scatter(things, region, min_gap=0.01, max_tries=40_000)
    apart = np.linalg.norm(poses[:, None, :2, 3] - poses[None, :, :2, 3], axis=2)[np.triu_indices(11, 1)]
    assert apart.min() >= 0.1 - 1e-3  # polygons of 24 corners are up to 0.4 mm thinner than discs
    monkeypatch.setattr(placement, "_TIGHT", 2.0)
    with pytest.raises(LayoutError):
        scatter(things, region, min_gap=0.01, max_tries=40_000)


def test_objects_repeat_only_when_there_are_too_few():
    rng = np.random.default_rng(0)
    assert sorted(draw_object_ids(rng, ["a", "b", "c"], 3)) == ["a", "b", "c"]
    assert sorted(draw_object_ids(rng, ["a", "b"], 5)).count("a") in (2, 3)
    counts = {draw_object_ids(rng, ["a", "b"], 4, repeats=True).count("a") for _ in range(100)}
    assert counts == {0, 1, 2, 3, 4}


# ---------------------------------------------------------------------------------------------- columns


def standing(width: float, depth: float, name: str = "a") -> PlaceableObject:
    """Return an object with its label on the -y side; the first pose is upright, the second more probable."""
    pose = np.eye(4)
    pose[2, 3] = 0.05
    outlines = [outline(width, depth)] * 2
    return PlaceableObject(name, np.stack([pose, pose]), np.array([0.1, 0.9]), outlines, display_pose=0)


def kinds(names: str, *sizes: tuple[float, float]) -> list[PlaceableObject]:
    """Return objects of several kinds with one size, or one size per kind."""
    return [standing(*size, name) for name, size in zip(names, sizes * (len(names) // len(sizes)), strict=True)]


def arrange(things, front=(-1.0, 0.0), seed=0, **options):
    layout = OrderlyLayout(kind="orderly", rows=8, **options)
    return sample_orderly(np.random.default_rng(seed), things, REGION, layout, np.array(front))


def columns(things, **options):
    poses, there = arrange(things, **options)
    assert there.all()
    return poses


def test_column_starts_at_the_front_edge():
    poses = columns(kinds("aaa", (0.06, 0.04)))
    # the front edge is at x = 0; depths of 4 cm with 1 cm between
    np.testing.assert_allclose(poses[:, 0, 3], [0.02, 0.07, 0.12])
    assert np.ptp(poses[:, 1, 3]) == pytest.approx(0)
    np.testing.assert_allclose(poses[:, 2, 3], 0.65)


@pytest.mark.parametrize("front", [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])
def test_labels_point_to_the_front(front):
    poses = columns(kinds("a", (0.06, 0.04)), front=front)
    np.testing.assert_allclose(poses[0, :3, :3] @ [0, -1, 0], [*front, 0], atol=1e-12)
    middle = {(-1.0, 0.0): 0.02, (1.0, 0.0): 0.28, (0.0, -1.0): -0.38, (0.0, 1.0): 0.38}[front]  # 2 cm from the edge
    assert poses[0, 0 if front[0] else 1, 3] == pytest.approx(middle)


def test_columns_have_their_spacing():
    poses = columns(kinds("ab", (0.06, 0.04), (0.10, 0.04)), column_spacing=1.5)
    assert abs(poses[0, 1, 3] - poses[1, 1, 3]) == pytest.approx(1.5 * 0.08)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), jitter=st.floats(0, 17), count=st.integers(1, 4))
def test_objects_in_columns_are_inside_and_apart(seed, jitter, count):
    things = kinds("aabbccdd"[: 2 * count], (0.08, 0.05))
    poses = columns(things, seed=seed, yaw_jitter_deg=jitter)
    outlines = []
    for pose, thing in zip(poses, things, strict=True):
        corners = thing.footprints[0] @ pose[:2, :2].T + pose[:2, 3]
        assert (corners >= np.array(REGION.min_xy) - 1e-9).all()
        assert (corners <= np.array(REGION.max_xy) + 1e-9).all()
        outlines.append(shapely.Polygon(corners))
    for i, one in enumerate(outlines):
        for other in outlines[i + 1 :]:
            assert one.distance(other) > 0.009


@pytest.mark.parametrize(
    ("things", "keep", "words"),
    [
        (kinds("abc", (0.3, 0.04)), False, r"3 columns side by side.*at most 0.80 m, found 1.08 m"),
        (kinds("aaa", (0.05, 0.12)), False, r"3 x a in a column.*at most 0.30 m, found 0.38 m"),
        (kinds("ab", (0.9, 0.04)), True, "side by side"),
        (kinds("ab", (0.05, 0.31)), True, "the first objects of all"),
    ],
)
def test_columns_that_do_not_fit_are_an_error(things, keep, words):
    with pytest.raises(LayoutError, match=words):
        arrange(things, keep_what_fits=keep)


def test_columns_are_kept_as_long_as_they_fit():
    # 1.3 x 0.2 m apart in 0.8 m: 0.2, 0.46, 0.72, and a fourth would end at 0.98 m
    poses, there = arrange(kinds("abcde", (0.2, 0.04)), keep_what_fits=True)
    assert there.sum() == 3
    ys = np.sort(poses[there, 1, 3])
    np.testing.assert_allclose(np.diff(ys), 0.26)
    assert ys[0] >= -0.3 and ys[-1] <= 0.3
    # 0.12 m deep and 1 cm apart: two take 0.25 of 0.3 m, three 0.38
    assert arrange(kinds("aaabbb", (0.05, 0.12)), keep_what_fits=True)[1].tolist() == [True, True, False] * 2


def test_objects_of_a_column_are_turned_together():
    yaws = []
    for seed in range(20):
        fronts = columns(kinds("aabbcc", (0.06, 0.04)), seed=seed, column_yaw="random")[:, :2, 1]
        np.testing.assert_allclose(fronts[::2], fronts[1::2])
        yaws += np.arctan2(*fronts[::2].T[::-1]).tolist()
    quarters = np.histogram(yaws, bins=4, range=(-np.pi, np.pi))[0]
    assert quarters.sum() == 60 and quarters.min() >= 6  # 15 each
