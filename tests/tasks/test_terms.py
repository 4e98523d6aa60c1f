import math

import pytest
import torch

from robocas_ms3.tasks import terms

YAW_90 = [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]
UPRIGHT = [1.0, 0, 0, 0]


def test_rotate_turns_x_to_y_and_back():
    q = torch.tensor([YAW_90, YAW_90])
    x, y = torch.tensor([[1.0, 0, 0]] * 2), torch.tensor([[0.0, 1, 0]] * 2)
    assert torch.allclose(terms.rotate(q, x), y, atol=1e-6)
    assert torch.allclose(terms.rotate_inverse(q, y), x, atol=1e-6)


def test_inside_box_follows_the_frame():
    # a box long in its own x, at (1, 0, 0); the second env has it turned by 90 degrees
    low, high = torch.tensor([-0.2, -0.1, 0.0]), torch.tensor([0.2, 0.1, 0.3])
    points = torch.tensor([[1.15, 0, 0.1], [1.15, 0, 0.1], [1.0, 0.15, 0.1], [1.0, 0, -0.01]])
    position = torch.tensor([[1.0, 0, 0]] * 4)
    quaternion = torch.tensor([UPRIGHT, YAW_90, YAW_90, UPRIGHT])
    assert terms.inside_box(points, position, quaternion, low, high).tolist() == [True, False, True, False]


def test_inside_box_of_several_objects_an_env():
    low, high = torch.tensor([-0.2, -0.1, 0.0]), torch.tensor([0.2, 0.1, 0.3])
    points = torch.tensor([[[1.15, 0, 0.1], [1.0, 0.15, 0.1], [0.85, 0.05, 0.2]]] * 2)
    position, quaternion = torch.tensor([[1.0, 0, 0]] * 2), torch.tensor([UPRIGHT, YAW_90])
    inside = terms.inside_box(points, position, quaternion, low, high)
    assert inside.tolist() == [[True, False, True], [False, True, False]]


def test_another_of_its_kind_is_neither_the_target_nor_of_another_kind():
    kinds = torch.tensor([[0, 0, 2, 2], [0, 1, 0, 1], [0, 0, 2, 2]])
    marked = torch.tensor([[True, False, True, True], [False, True, True, False], [True, False, False, True]])
    target = torch.tensor([0, 0, 1])
    assert terms.another_of_its_kind(marked, kinds, target).tolist() == [False, True, True]


def test_finger_grasps_needs_both_fingers_pressed_apart():
    closing = torch.tensor([[0.0, 1, 0]])
    left = torch.tensor([[[0, 2.0, 0], [0, 2.0, 0], [0, 0.4, 0], [0, -2.0, 0]]])
    right = torch.tensor([[[0, -2.0, 0], [0, 0.0, 0], [0, -2.0, 0], [0, 2.0, 0]]])
    # held; one finger only; too weak on the left; pulled inwards
    assert terms.finger_grasps(left, right, closing).tolist() == [[True, False, False, False]]


def test_finger_grasps_refuses_a_force_across_the_closing_axis():
    closing = torch.tensor([[0.0, 1, 0]])
    across = torch.tensor([[[3.0, 0.1, 0]]])  # 88 degrees off
    assert not terms.finger_grasps(across, -across, closing).any()
    assert terms.finger_grasps(across, -across, closing, max_angle_deg=89).all()


def test_pressed_asks_for_both_fingers_but_no_direction():
    left = torch.tensor([[[0, 2.0, 0], [0, 2.0, 0], [0, -2.0, 0]]])
    right = torch.tensor([[[3.0, 0, 0], [0, 0.4, 0], [0, 0.0, 0]]])
    assert terms.pressed(left, right).tolist() == [[True, False, False]]


@pytest.mark.parametrize(("degrees", "shift", "expected"), [(29.0, 0.0, False), (31.0, 0.0, True), (0.0, 0.031, True)])
def test_disturbed_is_moved_or_fallen_over(degrees, shift, expected):
    half = math.radians(degrees) / 2
    start = torch.tensor([[[1.0, 2.0, 3.0, *UPRIGHT]]])
    now = torch.tensor([[[1.0 + shift, 2.0, 3.0, math.cos(half), 0, math.sin(half), 0]]])
    assert terms.disturbed(now, start).tolist() == [[expected]]


def test_disturbed_goes_with_what_objects_stand_on():
    start = torch.tensor([[[1.0, 0, 0, *UPRIGHT], [1.0, 0, 0, *UPRIGHT]]])
    now = torch.tensor([[[0.0, 1.0, 0, *YAW_90], [1.0, 0, 0, *UPRIGHT]]])  # the first went along, the second did not
    back = torch.tensor([[0.0, 0, 0, YAW_90[0], 0, 0, -YAW_90[3]]])
    assert terms.disturbed(now, start, back).tolist() == [[False, True]]


def test_touched_is_any_body():
    forces = torch.zeros(2, 3, 4, 3)
    forces[0, 2, 1, 0] = 0.5
    forces[1, 0, 3, 2] = 1e-4  # noise
    assert terms.touched(forces).tolist() == [[False, True, False, False], [False] * 4]


def test_lifted_needs_height_and_grasp():
    height, rest = torch.tensor([[0.65, 0.65, 0.62]]), torch.tensor([[0.61, 0.61, 0.61]])
    assert terms.lifted(height, rest, torch.tensor([[True, False, True]])).tolist() == [[True, False, False]]


def test_at_rest_limits_both_velocities():
    linear = torch.tensor([[0.02, 0, 0], [0.04, 0, 0], [0, 0, 0]])
    angular = torch.tensor([[0.1, 0, 0], [0, 0, 0], [0, 0, 0.6]])
    assert terms.at_rest(linear, angular).tolist() == [True, False, False]


@pytest.mark.parametrize("degrees", [0.0, 19.9, 20.1, 90.0, 180.0])
def test_basket_stands_up_to_20_degrees(degrees):
    half = math.radians(degrees) / 2
    tilted = torch.tensor([[math.cos(half), math.sin(half), 0, 0]])
    upright, origin = torch.tensor([UPRIGHT]), torch.zeros(1, 3)
    # tilted about x, the vertical axis leans towards -y
    lean = [0, -math.sin(2 * half), math.cos(2 * half)]
    assert terms.upward(tilted)[0].tolist() == pytest.approx(lean, abs=1e-6)
    assert terms.stands(origin, tilted, origin, upright).item() is (degrees <= 20)


def test_basket_stands_up_to_10_cm_and_may_turn():
    upright, turned = torch.tensor([UPRIGHT]), torch.tensor([YAW_90])
    assert terms.stands(torch.tensor([[0.06, 0.06, 0]]), turned, torch.zeros(1, 3), upright).all()
    assert not terms.stands(torch.tensor([[0.08, 0.08, 0]]), upright, torch.zeros(1, 3), upright).any()


def test_of_target_picks_one_slot_per_env():
    values = torch.arange(6).reshape(2, 3)
    assert terms.of_target(values, torch.tensor([2, 0])).tolist() == [2, 3]
