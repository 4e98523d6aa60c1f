import numpy as np
import pytest
from models import box

from asset_tools.quality.hulls import compute_mean_thickness, compute_volume_iou, measure_hull_quality


def vertices(mesh):
    return np.asarray(mesh.vertices)


def test_a_box_is_its_own_hull():
    body = box((0.1, 0.06, 0.04))
    found = measure_hull_quality(body, [vertices(body)])
    assert (found.compact, found.hull_count, found.hull_vertices) == (True, 1, 8)
    assert found.volume_iou == pytest.approx(1, abs=1e-5)
    assert found.surface_p95 < 1e-6


def test_overlap_of_shifted_boxes_is_known():
    body = box((2.0, 1.0, 1.0))
    assert compute_volume_iou(body, [vertices(body)]) == pytest.approx(1.0, abs=1e-6)
    assert compute_volume_iou(body, [vertices(body) + [1.0, 0, 0]]) == pytest.approx(1 / 3, abs=1e-6)


def test_distance_to_a_hull_that_is_larger_all_round():
    # 4 mm off each face. Of the larger one's faces 5 % lie more than d beyond the smaller one's edges, where
    # ((200 + 2 d) / 208)^2 = 0.95, d = 1.37 mm; they are more than sqrt(4^2 + 1.37^2) = 4.23 mm off.
    found = measure_hull_quality(box((0.2, 0.2, 0.2)), [vertices(box((0.208, 0.208, 0.208)))])
    assert found.surface_p95 == pytest.approx(0.00423, abs=1e-4)


def test_distance_is_taken_both_ways():
    # The body is covered by the hulls, but a fifth of their surface is a lump at 3 cm that the body does not have.
    body = box((0.1, 0.1, 0.1))
    lump = box((0.05, 0.05, 0.05), at=(0, 0, 0.11))
    assert measure_hull_quality(body, [vertices(body), vertices(lump)]).surface_p95 == pytest.approx(0.08, abs=0.012)


def test_thin_objects_are_not_compact():
    assert compute_mean_thickness(box((0.1, 0.1, 0.1))) == pytest.approx(0.1 / 3)  # 2 a^3 / 6 a^2
    assert compute_mean_thickness(box((10, 10, 0.006))) == pytest.approx(0.006, rel=1e-2)
    plate = box((0.1, 0.1, 0.006))
    assert not measure_hull_quality(plate, [vertices(plate)]).compact
    cube = box((0.1, 0.1, 0.1))
    assert measure_hull_quality(cube, [vertices(cube)]).compact
    assert not measure_hull_quality(cube, [vertices(cube)], hollow=True).compact


def test_hulls_inside_one_another_count_once():
    body = box((0.1, 0.1, 0.1))
    found = measure_hull_quality(body, [vertices(body), vertices(box((0.05, 0.05, 0.05)))])
    assert found.hull_count == 2
    assert found.volume_iou == pytest.approx(1, abs=1e-5)
    assert found.surface_p95 < 1e-6
