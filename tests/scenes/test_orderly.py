"""Rows worked out by hand, and the laws of any of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.scenes.orderly import sample_orderly
from robocas_ms3.scenes.placement import PlaceableObject, Region

REGION = Region((0.0, -0.4), (0.3, 0.4), 0.6)


def box(width: float, depth: float, height: float = 0.1) -> PlaceableObject:
    """Its label is on the side at -y, ``width`` wide; the second pose is more probable, the first is upright."""
    outline = np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]]) / 2
    pose = np.eye(4)
    pose[2, 3] = height / 2
    return PlaceableObject("box", np.stack([pose, pose]), np.array([0.1, 0.9]), [outline, outline], display_pose=0)


def kept(things, columns, front=(-1.0, 0.0), seed=0, **options):
    options = {"row_gap": 0.01, **options}
    return sample_orderly(np.random.default_rng(seed), things, columns, REGION, front=np.array(front), **options)


def rows(things, columns, *more, **options):
    poses, there = kept(things, columns, *more, **options)
    assert there.all()
    return poses


def test_a_column_begins_at_the_front_edge_and_goes_back():
    poses = rows([box(0.06, 0.04)] * 3, ["a"] * 3)
    # the front edge is at x = 0; depths of 4 cm with 1 cm between
    np.testing.assert_allclose(poses[:, 0, 3], [0.02, 0.07, 0.12])
    assert np.ptp(poses[:, 1, 3]) == pytest.approx(0)
    np.testing.assert_allclose(poses[:, 2, 3], 0.65)


@pytest.mark.parametrize("front", [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])
def test_labels_look_out_of_the_front(front):
    poses = rows([box(0.06, 0.04)], ["a"], front=front)
    np.testing.assert_allclose(poses[0, :3, :3] @ [0, -1, 0], [*front, 0], atol=1e-12)
    middle = {(-1.0, 0.0): 0.02, (1.0, 0.0): 0.28, (0.0, -1.0): -0.38, (0.0, 1.0): 0.38}[front]  # 2 cm from the edge
    assert poses[0, 0 if front[0] else 1, 3] == pytest.approx(middle)


def test_columns_are_apart_by_their_spacing():
    poses = rows([box(0.06, 0.04), box(0.10, 0.04)], ["a", "b"], column_spacing=1.5)
    assert abs(poses[0, 1, 3] - poses[1, 1, 3]) == pytest.approx(1.5 * 0.08)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), jitter=st.floats(0, 0.3), columns=st.integers(1, 4))
def test_everything_stands_inside_and_apart(seed, jitter, columns):
    things = [box(0.08, 0.05)] * (2 * columns)
    names = [f"column {i // 2}" for i in range(2 * columns)]
    poses = rows(things, names, seed=seed, yaw_jitter=jitter)
    import shapely

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
    ("things", "columns", "words"),
    [
        ([box(0.3, 0.04)] * 3, ["a", "b", "c"], r"3 columns side by side.*at most 0.80 m, found 1.08 m"),
        ([box(0.05, 0.12)] * 3, ["a"] * 3, r"3 x box in a column.*at most 0.30 m, found 0.38 m"),
    ],
)
def test_what_does_not_fit_is_said(things, columns, words):
    with pytest.raises(LayoutError, match=words):
        rows(things, columns)


def test_columns_are_kept_as_long_as_they_fit():
    # 1.3 x 0.2 m apart in 0.8 m: 0.2, 0.46, 0.72, and a fourth would end at 0.98 m
    poses, there = kept([box(0.2, 0.04)] * 5, list("abcde"), keep_what_fits=True)
    assert there.sum() == 3
    ys = np.sort(poses[there, 1, 3])
    np.testing.assert_allclose(np.diff(ys), 0.26)
    assert ys[0] >= -0.3 and ys[-1] <= 0.3
    # a wide one ends it, though a narrow one after it would fit
    things = [box(0.3, 0.04), box(0.3, 0.04), box(0.6, 0.04), box(0.02, 0.04)]
    assert kept(things, list("abcd"), keep_what_fits=True)[1].tolist() == [True, True, False, False]


def test_objects_behind_the_region_are_left_out():
    # 0.12 m deep and 1 cm apart: two take 0.25 of 0.3 m, three 0.38
    _, there = kept([box(0.05, 0.12)] * 6, ["a"] * 3 + ["b"] * 3, keep_what_fits=True)
    assert there.tolist() == [True, True, False] * 2


@pytest.mark.parametrize(("size", "words"), [((0.9, 0.04), "side by side"), ((0.05, 0.31), "even the first objects")])
def test_nothing_that_fits_is_an_error(size, words):
    with pytest.raises(LayoutError, match=words):
        kept([box(*size)] * 2, ["a", "b"], keep_what_fits=True)


def test_a_column_is_turned_as_one():
    things, columns = [box(0.06, 0.04)] * 6, ["a", "a", "b", "b", "c", "c"]
    yaws = []
    for seed in range(20):
        poses = rows(things, columns, seed=seed, turn_columns=True)
        fronts = poses[:, :2, 1]
        np.testing.assert_allclose(fronts[::2], fronts[1::2])
        yaws += np.arctan2(*fronts[::2].T[::-1]).tolist()
    quarters = np.histogram(yaws, bins=4, range=(-np.pi, np.pi))[0]
    assert quarters.sum() == 60 and quarters.min() >= 6  # 15 each
