import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from robocas_ms3.core import arrays, rotations
from robocas_ms3.tasks import terms

YAW_90 = [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]
UPRIGHT = [1.0, 0, 0, 0]


def test_rotations_equal_those_of_scipy(make_array):
    found = Rotation.random(5, random_state=0)
    quaternions = make_array(found.as_quat()[:, [3, 0, 1, 2]].astype("float32").reshape(1, 5, 4))
    vectors = np.random.default_rng(0).uniform(-1, 1, (1, 5, 3)).astype(np.float32)
    for turned, expected in (
        (rotations.to_matrix(quaternions), found.as_matrix()),
        (rotations.rotate(quaternions, make_array(vectors)), found.apply(vectors[0])),
        (rotations.rotate_inverse(quaternions, make_array(vectors)), found.inv().apply(vectors[0])),
        (rotations.vertical_axis(quaternions), found.apply([0, 0, 1])),
    ):
        assert abs(np.asarray(turned)[0] - expected).max() < 1e-6


def test_native_arrays_on_a_cpu_are_numpy_arrays_with_shared_memory():
    tensor = torch.zeros(2)
    arrays.to_native(tensor)[1] = 3.0
    assert tensor.tolist() == [0, 3]
    assert arrays.as_tensor(tensor) is tensor
    arrays.as_tensor(arrays.to_native(tensor))[0] = 1.0
    assert tensor.tolist() == [1, 3]


def test_inside_box_follows_the_frame(make_array):
    # a box that is long in its x axis, at (1, 0, 0); in the second env it is turned by 90 degrees
    low, high = make_array([-0.2, -0.1, 0.0]), make_array([0.2, 0.1, 0.3])
    points = make_array([[1.15, 0, 0.1], [1.15, 0, 0.1], [1.0, 0.15, 0.1], [1.0, 0, -0.01]])
    position = make_array([[1.0, 0, 0]] * 4)
    quaternion = make_array([UPRIGHT, YAW_90, YAW_90, UPRIGHT])
    assert terms.is_inside_box(points, position, quaternion, low, high).tolist() == [True, False, True, False]


def test_inside_box_of_several_objects_per_env(make_array):
    low, high = make_array([-0.2, -0.1, 0.0]), make_array([0.2, 0.1, 0.3])
    points = make_array([[[1.15, 0, 0.1], [1.0, 0.15, 0.1], [0.85, 0.05, 0.2]]] * 2)
    position, quaternion = make_array([[1.0, 0, 0]] * 2), make_array([UPRIGHT, YAW_90])
    inside = terms.is_inside_box(points, position, quaternion, low, high)
    assert inside.tolist() == [[True, False, True], [False, True, False]]


def test_other_object_of_the_kind_is_not_the_target(make_array):
    kinds = make_array([[0, 0, 2, 2], [0, 1, 0, 1], [0, 0, 2, 2]])
    marked = make_array([[True, False, True, True], [False, True, True, False], [True, False, False, True]])
    target = make_array([0, 0, 1])
    assert terms.has_other_of_kind(marked, kinds, target).tolist() == [False, True, True]


def test_grasp_needs_both_fingers_pressed_apart(make_array):
    closing = make_array([[0.0, 1, 0]])
    left = make_array([[[0, 2.0, 0], [0, 2.0, 0], [0, 0.4, 0], [0, -2.0, 0], [3.0, 0.1, 0]]])
    right = make_array([[[0, -2.0, 0], [0, 0.0, 0], [0, -2.0, 0], [0, 2.0, 0], [-3.0, -0.1, 0]]])
    # held; one finger only; too weak on the left; pulled inwards; 88 degrees off the closing axis
    assert terms.is_grasped(left, right, closing).tolist() == [[True, False, False, False, False]]


def test_pressing_needs_both_fingers_in_any_direction(make_array):
    left = make_array([[[0, 2.0, 0], [0, 2.0, 0], [0, -2.0, 0]]])
    right = make_array([[[3.0, 0, 0], [0, 0.4, 0], [0, 0.0, 0]]])
    assert terms.presses_both_fingers(left, right).tolist() == [[True, False, False]]


@pytest.mark.parametrize(("degrees", "shift", "expected"), [(29.0, 0.0, False), (31.0, 0.0, True), (0.0, 0.031, True)])
def test_disturbed_object_is_shifted_or_fallen(make_array, degrees, shift, expected):
    half = math.radians(degrees) / 2
    start = make_array([[[1.0, 2.0, 3.0, *UPRIGHT]]])
    now = make_array([[[1.0 + shift, 2.0, 3.0, math.cos(half), 0, math.sin(half), 0]]])
    assert terms.is_disturbed(now, start).tolist() == [[expected]]


def test_disturbance_is_relative_to_the_support(make_array):
    start = make_array([[[1.0, 0, 0, *UPRIGHT], [1.0, 0, 0, *UPRIGHT]]])
    now = make_array(
        [[[0.0, 1.0, 0, *YAW_90], [1.0, 0, 0, *UPRIGHT]]]
    )  # the first object moved with the support, the second did not
    back = make_array([[[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]]), make_array([[0.0, 0, 0]])
    assert terms.is_disturbed(now, start, back).tolist() == [[False, True]]


def test_inverse_part_motion_of_a_drawer(make_array):
    # a cabinet at (1, 2, 0), facing y; its drawer was 0.5 m along the cabinet's own x, and is out by another 0.2 m
    body, part = make_array([[1.0, 2, 0, *YAW_90]]), make_array([[1.0, 2.7, 0, *YAW_90]])
    before = make_array([[1.0, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    turn, shift = terms.inverse_part_motion(body, part, before)
    assert abs(turn[0] - make_array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])).max() < 1e-6
    assert abs(shift[0] - make_array([0.0, -0.2, 0])).max() < 1e-6
    # a door at the origin that has turned by 90 degrees about its hinge at (1, 0, 0)
    turn, shift = terms.inverse_part_motion(
        make_array([[0.0, 0, 0, *UPRIGHT]]), make_array([[1.0, 0, 0, *YAW_90]]), make_array(hinge_at_1())
    )
    on_the_door = turn[0] @ make_array([1.0, 0.4, 0]) + shift[0]
    assert abs(on_the_door - make_array([1.4, 0, 0])).max() < 1e-6


def hinge_at_1() -> list[list[float]]:
    return [[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def test_touching_any_body_counts(make_array):
    forces = torch.zeros(2, 3, 4, 3)
    forces[0, 2, 1, 0] = 0.5
    forces[1, 0, 3, 2] = 1e-4  # noise
    assert terms.is_touched(make_array(forces)).tolist() == [[False, True, False, False], [False] * 4]


def test_lifted_needs_height_and_grasp(make_array):
    height, rest = make_array([[0.65, 0.65, 0.62]]), make_array([[0.61, 0.61, 0.61]])
    assert terms.is_lifted(height, rest, make_array([[True, False, True]])).tolist() == [[True, False, False]]


def test_rest_limits_both_velocities(make_array):
    linear = make_array([[0.02, 0, 0], [0.04, 0, 0], [0, 0, 0]])
    angular = make_array([[0.1, 0, 0], [0, 0, 0], [0, 0, 0.6]])
    assert terms.is_at_rest(linear, angular).tolist() == [True, False, False]


@pytest.mark.parametrize("degrees", [0.0, 19.9, 20.1, 90.0, 180.0])
def test_basket_stands_up_to_20_degrees(make_array, degrees):
    half = math.radians(degrees) / 2
    tilted = make_array([[math.cos(half), math.sin(half), 0, 0]])
    upright, origin = make_array([UPRIGHT]), make_array([[0.0, 0, 0]])
    assert terms.is_basket_standing(origin, tilted, origin, upright).item() is (degrees <= 20)


def test_basket_stands_up_to_10_cm_and_may_turn(make_array):
    upright, turned = make_array([UPRIGHT]), make_array([YAW_90])
    assert terms.is_basket_standing(make_array([[0.06, 0.06, 0]]), turned, make_array([[0.0, 0, 0]]), upright).all()
    assert not terms.is_basket_standing(
        make_array([[0.08, 0.08, 0]]), upright, make_array([[0.0, 0, 0]]), upright
    ).any()


def test_fallen_target_is_below_the_surface_outside_of_basket_and_gripper(make_array):
    height = make_array([0.57, 0.54, 0.54, 0.54])  # of a surface at 0.6
    above, touched = make_array([False, False, True, False]), make_array([False, False, False, True])
    assert terms.has_target_fallen(height, 0.6, above, touched).tolist() == [False, True, False, False]


@pytest.mark.parametrize(("degrees", "drop", "expected"), [(59, 0.09, False), (61, 0.0, True), (0, 0.11, True)])
def test_basket_has_fallen_if_tilted_or_lower(make_array, degrees, drop, expected):
    half = math.radians(degrees) / 2
    tilted, upright = make_array([[math.cos(half), math.sin(half), 0, 0]]), make_array([UPRIGHT])
    at, before = make_array([[0.5, 0, 0.7 - drop]]), make_array([[0.0, 0, 0.7]])
    assert terms.has_basket_fallen(at, tilted, before, upright).tolist() == [expected]


def test_select_target_picks_one_slot_per_env(make_array):
    values = make_array([[0, 1, 2], [3, 4, 5]])
    assert terms.select_target(values, make_array([2, 0])).tolist() == [2, 3]
