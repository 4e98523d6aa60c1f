"""Projection of points to image cells, attention over cells, and unprojection of cells to points."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.small.config import CameraView
from robocas_ms3.baselines.small.localization import (
    NOWHERE,
    POINT_FEATURES,
    CellAttention,
    Unproject,
    compute_cell_losses,
    compute_heights_in_base,
    pixel_to_cell,
    project_points_to_view,
)
from robocas_ms3.baselines.training.metrics import mean_of_sum_and_count
from robocas_ms3.core.poses import from_rotation, inverse, transform_points

INTRINSIC = np.array([64.0, 64.0, 32.0, 24.0])  # of 64 x 48 images: 0.5 m to the side at 1 m is at the edge
WHOLE = CameraView(image_size=(64, 48), size=(64, 48))  # 8 x 6 cells


def place(point, view=WHOLE, stored=(64, 48), intrinsic=INTRINSIC, camera=None):
    camera = np.eye(4) if camera is None else camera
    return torch.from_numpy(project_points_to_view(np.array(point, float), camera, intrinsic, stored, view))


def cell(point, view=WHOLE, **more):
    return int(pixel_to_cell(place(point, view, **more), view))


def test_pixels_and_cells_of_points():
    assert place([[0.25, -0.125, 2]]).tolist() == [[40, 20]]
    assert place([[-1.0, 0, 1]]).tolist() == [[-32, 24]]  # out of it
    assert place([[0.1, 0, -1]]).isnan().all()  # behind
    points = [[0.001, 0.001, 1], [-0.499, -0.374, 1], [0.499, 0.374, 1], [0.25, 0, 2], [0.51, 0, 1], [0.001, 0.001, -1]]
    assert [cell(point) for point in points] == [3 * 8 + 4, 0, 47, 3 * 8 + 5, NOWHERE, NOWHERE]  # 3 * 8 + 4: the middle


def test_cells_of_a_crop_another_size_or_another_camera():
    right = CameraView(image_size=(64, 48), crop=(0.5, 0.0, 1.0, 1.0), size=(64, 96))  # twice as large: 8 x 12 cells
    assert cell([0.001, 0.001, 1], right) == 6 * 8
    assert cell([-0.01, 0, 1], right) == NOWHERE
    assert cell([0.1, -0.2, 1], stored=(128, 96), intrinsic=2 * INTRINSIC) == cell([0.1, -0.2, 1])
    turned = np.array([[0, 0, 1, 0.5], [-1, 0, 0, 0], [0, -1, 0, 0.2], [0, 0, 0, 1.0]])  # looks along x of its parent
    assert cell([1.5, -0.001, 0.199], camera=turned) == 3 * 8 + 4


def test_losses_skip_labels_outside_the_image():
    logits = torch.zeros(3, 48)
    logits[0, 9], logits[1, 20] = 50.0, 50.0
    loss, found = compute_cell_losses(logits, torch.tensor([[9], [0], [NOWHERE]]), 8)
    assert loss.tolist() == [50.0, 2.0]  # right: 0; wrong: by 50
    assert found.tolist() == [1.0, 2.0]
    _, near = compute_cell_losses(logits, torch.tensor([[18], [NOWHERE], [NOWHERE]]), 8)  # one down, one right of 9
    assert near.tolist() == [1.0, 1.0]
    assert compute_cell_losses(logits, torch.full((3, 1), NOWHERE), 8)[0].tolist() == [0.0, 0.0]


def test_each_of_several_labels_is_correct():
    logits = torch.zeros(1, 1, 4)
    logits.requires_grad_()
    loss, found = compute_cell_losses(logits, torch.tensor([[[1, 3, NOWHERE]]]), 2)
    assert loss.tolist() == [np.float32(np.log(2)), 1.0]  # half of what was said to be likely
    loss[0].backward()
    assert logits.grad.flatten().tolist() == [0.25, -0.25, 0.25, -0.25]
    assert found.tolist() == [1.0, 1.0]


def test_attention_learns_to_find_the_queried_channel():
    """Each of four channels is 1 in one cell; the query is a channel number, the label its cell."""
    torch.manual_seed(0)
    attention = CellAttention(WHOLE, channels=4, width=4)
    optimizer = torch.optim.Adam(attention.parameters(), lr=0.05)
    for _ in range(200):
        cells = torch.stack([torch.randperm(48)[:4] for _ in range(32)])
        maps = torch.nn.functional.one_hot(cells, 48).float().reshape(32, 4, 6, 8)
        names = torch.randint(0, 4, (32, 2))
        logits = attention.logits(maps, torch.nn.functional.one_hot(names, 4).float())
        loss, found = compute_cell_losses(logits, cells.gather(1, names)[..., None], 8)
        optimizer.zero_grad()
        mean_of_sum_and_count(loss).backward()
        optimizer.step()
    assert mean_of_sum_and_count(found) == 1.0


DOWN = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.0], [0, 0, 0, 1]]  # a metre above the base, looking straight down


def unproject(mount=DOWN, on_hand=False, intrinsic=(32, 32, 32, 24), heights=(0.0, 1.0)) -> Unproject:
    return Unproject(WHOLE, {"on_hand": on_hand, "mount": mount, "intrinsic": intrinsic}, heights, 4, 8)


def random_tcp_pose(seed=0):
    """Return a random TCP pose in front of the arm, (1, 4, 4)."""
    draw = np.random.default_rng(seed)
    turn = Rotation.from_euler("xyz", [np.pi, 0, 0]) * Rotation.from_rotvec(draw.normal(size=3) * 0.2)
    return from_rotation(np.array([[0.5, 0.1, 0.3]]) + draw.normal(size=(1, 3)) * 0.1, turn.as_matrix()[None])


def test_height_above_the_camera_gives_no_point_behind_it():
    found = unproject().unproject_pixels(torch.tensor([[48.0, 24.0]]), torch.tensor([1.5]), torch.eye(4)[None])
    assert found[0].tolist() == pytest.approx([0, 0, 1.0], abs=1e-6)


@given(
    x=st.floats(-0.3, 0.3), y=st.floats(-0.3, 0.3), z=st.floats(0, 0.3), seed=st.integers(0, 99), on_hand=st.booleans()
)
def test_visible_point_is_unprojected_to_its_position(x, y, z, seed, on_hand):
    """The point follows from its pixel and height, for cameras on the gripper and in the base frame."""
    tcp, mount, intrinsic = random_tcp_pose(seed), np.array(DOWN), np.array([40.0, 40.0, 32.0, 24.0])
    if on_hand:
        mount = inverse(random_tcp_pose(1)[0]) @ mount
    camera = tcp[0] @ mount if on_hand else mount
    point = np.array([0.4 + x, y, z])
    assume(
        transform_points(inverse(camera), point[None])[0, 2] > 0.1 and camera[2, 3] > z + 0.05
    )  # before it, and below
    place = project_points_to_view(point[None], camera, intrinsic, (64, 48), WHOLE)
    ray = point - camera[:3, 3]
    assume(-ray[2] > 0.05 * np.linalg.norm(ray))  # not level with it
    own = unproject(mount.tolist(), on_hand, intrinsic.tolist())
    with torch.autocast("cpu", torch.bfloat16):  # in which matrices are multiplied; a point stays where it is
        found = own.unproject_pixels(torch.from_numpy(place), torch.tensor([z]), torch.from_numpy(tcp).float())
    expected = transform_points(inverse(tcp[0]), point[None])
    assert found.numpy() == pytest.approx(expected, abs=2e-3)


def test_point_is_that_of_the_most_probable_cell_without_the_shift():
    """The point is a quarter of a cell right of the centre of the fourth cell of the first row, at 20 cm."""
    own, tcp = unproject(), torch.eye(4)[None]
    with torch.no_grad():
        own.offsets.weight.zero_()
        own.offsets.bias.copy_(torch.tensor([0.25, 0.0]))
        own.height[2].weight.zero_()
        own.height[2].bias.fill_(0.2)
    logits = torch.full((1, 48), -9.0)
    logits[0, 3] = 9.0
    points, said = own(torch.zeros(1, 4, 6, 8), torch.zeros(1, 8), logits, tcp, torch.tensor([[2, 0]]))
    x, y = 3 * 8 + 4 + 2 - 2, 4  # the middle, a quarter of 8, and the shift that is taken back
    assert points[0].tolist() == pytest.approx([(x - 32) / 32 * 0.8, (24 - y) / 32 * 0.8, 0.2], abs=1e-5)
    assert said.shape == (1, POINT_FEATURES) and said[0, -1] > 0.99 and not said.requires_grad


def test_loss_counts_objects_in_the_image():
    """One of two objects is in the image: 2 px off the centre of its cell, 5 cm above the prediction."""
    own = unproject()
    with torch.no_grad():
        for layer in (own.offsets, own.height[2]):
            layer.weight.zero_()
            layer.bias.zero_()
    fine, queries = torch.zeros(1, 4, 6, 8), torch.zeros(1, 2, 8)
    places, heights = torch.tensor([[[14.0, 4.0], [-5.0, 4.0]]]), torch.tensor([[0.05, 7.0]])
    assert own.loss(fine, queries, places, heights).item() == pytest.approx(2 / 8 + 1)  # in cells, and in 5 cm
    assert own.loss(fine, queries, torch.full((1, 2, 2), torch.nan), heights).item() == 0


def test_heights_are_in_the_base_frame():
    tcp = torch.from_numpy(random_tcp_pose()).float()
    assert float(compute_heights_in_base(torch.zeros(1, 3), tcp)) == pytest.approx(float(tcp[0, 2, 3]))
    above = tcp[:, :3, :3].transpose(1, 2) @ torch.tensor([0.0, 0.0, 0.1])
    assert float(compute_heights_in_base(above, tcp)) == pytest.approx(float(tcp[0, 2, 3]) + 0.1)
