"""From pixels to points: on the ray, at the height."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.chunks import state_of
from robocas_ms3.baselines.small.config import View
from robocas_ms3.baselines.small.lifting import SAID, Lift, heights_of, tcp_of
from robocas_ms3.baselines.small.pointing import places_of
from robocas_ms3.core.poses import from_parts, inverse, transform

VIEW = View(rendered=(64, 48), size=(64, 48))
DOWN = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.0], [0, 0, 0, 1]]  # a metre above the base, looking straight down
METRE = 0.0, 1.0  # heights are in metres


def lift(mount=DOWN, on_hand=False, intrinsic=(32, 32, 32, 24), heights=METRE) -> Lift:
    return Lift(VIEW, {"on_hand": on_hand, "mount": mount, "intrinsic": intrinsic}, heights, 4, 8)


def turned(seed=0):
    """A TCP somewhere before the arm, (1, 4, 4)."""
    draw = np.random.default_rng(seed)
    turn = Rotation.from_euler("xyz", [np.pi, 0, 0]) * Rotation.from_rotvec(draw.normal(size=3) * 0.2)
    return from_parts(np.array([[0.5, 0.1, 0.3]]) + draw.normal(size=(1, 3)) * 0.1, turn.as_matrix()[None])


def test_what_the_arm_feels_says_where_its_tcp_is():
    tcp = turned()
    assert tcp_of(torch.from_numpy(state_of(tcp, np.array([0.08])))).numpy() == pytest.approx(tcp, abs=1e-6)


def test_a_pixel_of_a_camera_that_looks_down():
    """16 of 32 pixels' focal length off the middle: half as far aside as it is deep, 0.8 m above a level of 0.2."""
    found = lift()._lifted(torch.tensor([[48.0, 24.0]]), torch.tensor([0.2]), torch.eye(4)[None])
    assert found[0].tolist() == pytest.approx([0.4, 0.0, 0.2], abs=1e-6)


def test_what_lies_above_the_camera_is_no_point_behind_it():
    found = lift()._lifted(torch.tensor([[48.0, 24.0]]), torch.tensor([1.5]), torch.eye(4)[None])
    assert found[0].tolist() == pytest.approx([0, 0, 1.0], abs=1e-6)


@given(
    x=st.floats(-0.3, 0.3), y=st.floats(-0.3, 0.3), z=st.floats(0, 0.3), seed=st.integers(0, 99), on_hand=st.booleans()
)
def test_a_point_that_is_seen_is_found(x, y, z, seed, on_hand):
    """By its pixel and its height, whatever the camera is fixed to."""
    tcp, mount, intrinsic = turned(seed), np.array(DOWN), np.array([40.0, 40.0, 32.0, 24.0])
    if on_hand:
        mount = inverse(turned(1)[0]) @ mount
    camera = tcp[0] @ mount if on_hand else mount
    point = np.array([0.4 + x, y, z])
    assume(transform(inverse(camera), point[None])[0, 2] > 0.1 and camera[2, 3] > z + 0.05)  # before it, and below
    place = places_of(point[None], camera, intrinsic, (64, 48), VIEW)
    ray = point - camera[:3, 3]
    assume(-ray[2] > 0.05 * np.linalg.norm(ray))  # not level with it
    own = lift(mount.tolist(), on_hand, intrinsic.tolist())
    with torch.autocast("cpu", torch.bfloat16):  # in which matrices are multiplied; a point stays where it is
        found = own._lifted(torch.from_numpy(place), torch.tensor([z]), torch.from_numpy(tcp).float())
    expected = transform(inverse(tcp[0]), point[None])
    assert found.numpy() == pytest.approx(expected, abs=2e-3)


def test_it_reads_the_cell_that_is_pointed_at_and_takes_back_the_shift():
    """Told that a place is a quarter of a cell right of the middle of the fourth cell of the first row, at 20 cm."""
    own, tcp = lift(), torch.eye(4)[None]
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
    assert said.shape == (1, SAID) and said[0, -1] > 0.99 and not said.requires_grad


def test_a_loss_is_of_what_is_seen():
    """Of two things one is seen: 14 px from the edge, so 2 of its cell's middle, and 5 cm above what is said."""
    own = lift()
    with torch.no_grad():
        for layer in (own.offsets, own.height[2]):
            layer.weight.zero_()
            layer.bias.zero_()
    fine, asked = torch.zeros(1, 4, 6, 8), torch.zeros(1, 2, 8)
    places, heights = torch.tensor([[[14.0, 4.0], [-5.0, 4.0]]]), torch.tensor([[0.05, 7.0]])
    assert own.loss(fine, asked, places, heights).item() == pytest.approx(2 / 8 + 1)  # in cells, and in 5 cm
    assert own.loss(fine, asked, torch.full((1, 2, 2), torch.nan), heights).item() == 0


def test_heights_are_in_the_base():
    tcp = torch.from_numpy(turned()).float()
    assert float(heights_of(torch.zeros(1, 3), tcp)) == pytest.approx(float(tcp[0, 2, 3]))
    above = tcp[:, :3, :3].transpose(1, 2) @ torch.tensor([0.0, 0.0, 0.1])
    assert float(heights_of(above, tcp)) == pytest.approx(float(tcp[0, 2, 3]) + 0.1)
