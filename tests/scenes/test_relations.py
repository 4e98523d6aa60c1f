"""Relations between identical objects, computed by hand. The robot looks along x; its left is +y."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robocas_ms3.scenes.relations import MARGIN, RELATIONS, select_by_relation

# y = 0.2 is on the robot's left; distances 0.54, 0.6, 0.81, 0.7 m
FOUR = np.array([[0.5, 0.2], [0.6, 0.0], [0.8, -0.1], [0.63, -0.3]])


@pytest.mark.parametrize(
    ("relation", "expected"),
    [
        ("nearest", 0),
        ("second_nearest", 1),
        ("farthest", 2),
        ("leftmost", 0),
        ("second_from_left", 1),
        ("second_from_right", 2),
        ("rightmost", 3),
        ("middle", None),  # four have no middle
    ],
)
def test_four_objects(relation, expected):
    assert select_by_relation(relation, FOUR) == expected


@pytest.mark.parametrize(("order", "expected"), [([0, 1, 3], 1), ([3, 1, 0], 1), ([1, 0, 3], 0), ([0, 3, 1], 2)])
def test_middle_of_three_in_any_order(order, expected):
    assert select_by_relation("middle", FOUR[order]) == expected


def test_two_objects_have_no_middle():
    two = FOUR[:2]
    found = {relation: select_by_relation(relation, two) for relation in RELATIONS}
    assert {relation for relation, index in found.items() if index is not None} == {
        "nearest",
        "farthest",
        "leftmost",
        "rightmost",
    }
    assert found["nearest"] == found["leftmost"] == 0
    assert found["farthest"] == found["rightmost"] == 1
    assert all(select_by_relation(relation, FOUR[:count]) is None for relation in RELATIONS for count in (0, 1))


@pytest.mark.parametrize(("gap", "clear"), [(0.029, False), (0.031, True)])
def test_neighbours_closer_than_3_cm_are_ambiguous(gap, clear):
    row = np.array([[0.5, gap], [0.5, 0.0], [0.5, -0.2]])
    assert (select_by_relation("leftmost", row) == 0) is clear
    assert (select_by_relation("middle", row) == 1) is clear  # it has that neighbour too
    assert select_by_relation("rightmost", row) == 2  # it has not


POINTS = st.lists(
    st.tuples(st.floats(0.2, 1.0), st.floats(-0.5, 0.5)).map(lambda p: (round(p[0], 3), round(p[1], 3))),
    min_size=2,
    max_size=7,
)


@given(POINTS)
def test_mirror_image_swaps_left_and_right(points):
    here, mirrored = np.array(points), np.array(points) * [1, -1]
    for one, other in (("leftmost", "rightmost"), ("second_from_left", "second_from_right"), ("middle", "middle")):
        assert select_by_relation(one, here) == select_by_relation(other, mirrored)
    assert select_by_relation("nearest", here) == select_by_relation("nearest", mirrored)


@given(POINTS)
def test_named_object_differs_from_all_others(points):
    here = np.array(points)
    for relation, key in (("leftmost", here[:, 1]), ("farthest", np.linalg.norm(here, axis=1))):
        found = select_by_relation(relation, here)
        if found is not None:
            assert np.delete(key, found).max() <= key[found] - MARGIN + 1e-12


def test_without_a_margin_the_order_decides():
    close = np.array([[0.5, 0.01], [0.5, 0.0]])
    assert select_by_relation("leftmost", close) is None
    assert select_by_relation("leftmost", close, margin=0.0) == 0
