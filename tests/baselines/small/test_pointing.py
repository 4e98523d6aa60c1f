"""Where in a picture things are: places and cells by hand, and a pointer that learns what four channels mean."""

import numpy as np
import torch

from robocas_ms3.baselines.small.config import View
from robocas_ms3.baselines.small.pointing import NOWHERE, Pointer, cells_of, places_of, pointing_losses
from robocas_ms3.baselines.training.metrics import mean_of_sum

INTRINSIC = np.array([64.0, 64.0, 32.0, 24.0])  # of 64 x 48 pictures: 0.5 m to the side at 1 m is at the edge
WHOLE = View(rendered=(64, 48), size=(64, 48))  # 8 x 6 cells


def place(point, view=WHOLE, stored=(64, 48), intrinsic=INTRINSIC, camera=None):
    camera = np.eye(4) if camera is None else camera
    return torch.from_numpy(places_of(np.array(point, float), camera, intrinsic, stored, view))


def cell(point, view=WHOLE, **more):
    return int(cells_of(place(point, view, **more), view))


def test_places_by_hand():
    assert place([[0.25, -0.125, 2]]).tolist() == [[40, 20]]
    assert place([[-1.0, 0, 1]]).tolist() == [[-32, 24]]  # out of it
    assert place([[0.1, 0, -1]]).isnan().all()  # behind


def test_cells_by_hand():
    assert cell([0.001, 0.001, 1]) == 3 * 8 + 4  # the middle: pixel (32, 24)
    assert cell([-0.499, -0.374, 1]) == 0
    assert cell([0.499, 0.374, 1]) == 47
    assert cell([0.25, 0, 2]) == 3 * 8 + 5  # pixel 40
    assert cell([0.51, 0, 1]) == NOWHERE
    assert cell([0.001, 0.001, -1]) == NOWHERE  # behind


def test_cells_of_a_part():
    right = View(rendered=(64, 48), part=(0.5, 0.0, 1.0, 1.0), size=(64, 96))  # twice as large: 8 x 12 cells
    assert cell([0.001, 0.001, 1], right) == 6 * 8
    assert cell([-0.01, 0, 1], right) == NOWHERE


def test_cells_do_not_depend_on_the_stored_size():
    assert cell([0.1, -0.2, 1], stored=(128, 96), intrinsic=2 * INTRINSIC) == cell([0.1, -0.2, 1])


def test_a_camera_that_looks_elsewhere():
    turned = np.array([[0, 0, 1, 0.5], [-1, 0, 0, 0], [0, -1, 0, 0.2], [0, 0, 0, 1.0]])  # along x of its parent
    assert cell([1.5, -0.001, 0.199], camera=turned) == 3 * 8 + 4


def test_losses_leave_out_what_is_not_shown():
    logits = torch.zeros(3, 48)
    logits[0, 9], logits[1, 20] = 50.0, 50.0
    loss, found = pointing_losses(logits, torch.tensor([[9], [0], [NOWHERE]]), 8)
    assert loss.tolist() == [50.0, 2.0]  # right: 0; wrong: by 50
    assert found.tolist() == [1.0, 2.0]
    _, near = pointing_losses(logits, torch.tensor([[18], [NOWHERE], [NOWHERE]]), 8)  # one down, one right of 9
    assert near.tolist() == [1.0, 1.0]
    assert pointing_losses(logits, torch.full((3, 1), NOWHERE), 8)[0].tolist() == [0.0, 0.0]


def test_any_of_several_answers_is_right():
    logits = torch.zeros(1, 1, 4)
    logits.requires_grad_()
    loss, found = pointing_losses(logits, torch.tensor([[[1, 3, NOWHERE]]]), 2)
    assert loss.tolist() == [np.float32(np.log(2)), 1.0]  # half of what was said to be likely
    loss[0].backward()
    assert logits.grad.flatten().tolist() == [0.25, -0.25, 0.25, -0.25]
    assert found.tolist() == [1.0, 1.0]


def test_a_pointer_learns_to_find_what_is_asked_for():
    """Four channels light up at a cell each; asked for one by its number, it points there."""
    torch.manual_seed(0)
    pointer = Pointer(WHOLE, channels=4, width=4)
    optimizer = torch.optim.Adam(pointer.parameters(), lr=0.05)
    for _ in range(200):
        cells = torch.stack([torch.randperm(48)[:4] for _ in range(32)])
        maps = torch.nn.functional.one_hot(cells, 48).float().reshape(32, 4, 6, 8)
        asked = torch.randint(0, 4, (32, 2))
        logits = pointer.logits(maps, torch.nn.functional.one_hot(asked, 4).float())
        loss, found = pointing_losses(logits, cells.gather(1, asked)[..., None], 8)
        optimizer.zero_grad()
        mean_of_sum(loss).backward()
        optimizer.step()
    assert mean_of_sum(found) == 1.0
