"""Locate the object that an instruction names: its cell in an image, and its point in space by unprojection.

The loss of the chunks alone teaches the network poorly which object an instruction names. Auxiliary losses therefore
train attention over image cells. Their labels are the TCP position at the next change of the gripper command and, until
that change, the objects of the layout, with the instructions of other episodes. An image gives the direction of an
object to a few millimetres but not its distance. The point is therefore the intersection of the ray through a pixel
with the horizontal plane at a predicted height.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from robocas_ms3.baselines.small.config import View
from robocas_ms3.baselines.training.metrics import mean_of_sum
from robocas_ms3.core.poses import Array, inverse, transform_points

CELL = 8
"""Side length of a cell in pixels."""
NOWHERE = -1
"""Cell index of a point outside the image."""
POINT_FEATURES = 7
"""Features per point: three coarse coordinates, three fine coordinates, probability of the cell."""
_NEAREST = 0.01  # m in front of the camera
_FINE, _COARSE = 0.05, 0.3  # m, scales of the coordinates
_FURTHEST = 2.0  # m along a ray
_FLATTEST = 0.03  # smallest downward component of a ray's direction; flatter rays are clamped to it


def project_points(
    points: NDArray[np.floating], camera: Array, intrinsic: Array, stored: tuple[int, int], view: View
) -> NDArray[np.float32]:
    """Project points into the pixel coordinates of a view.

    Args:
        points: (..., 3) m, in the frame of the camera's parent.
        camera: (4, 4) pose of the OpenCV camera frame in that parent.
        intrinsic: (4,) fx, fy, cx, cy of the stored images, pixels.
        stored: width and height of the stored images, pixels.
        view: view of the camera.

    Returns:
        (..., 2) x and y, also of points outside the view; NaN behind the camera.
    """
    in_camera = transform_points(inverse(camera), np.asarray(points, np.float64))
    depth = np.maximum(in_camera[..., 2:], _NEAREST)
    fraction = (in_camera[..., :2] / depth * intrinsic[:2] + intrinsic[2:]) / np.array(stored)
    left, top, right, bottom = np.array(view.box()) / np.tile(view.image_size, 2)
    inside = (fraction - (left, top)) / (right - left, bottom - top)
    return np.where(in_camera[..., 2:] > _NEAREST, inside * view.size, np.nan).astype(np.float32)


def pixel_to_cell(pixels: torch.Tensor, view: View) -> torch.Tensor:
    """Return the row-major cell indices (...) of pixel coordinates (..., 2); `NOWHERE` outside the view."""
    size = torch.tensor(view.size, device=pixels.device)
    inside = ((pixels >= 0) & (pixels < size)).all(dim=-1)  # NaN is not
    cell = (pixels.nan_to_num(0.0) / CELL).floor().long()
    return torch.where(inside, cell[..., 1] * (view.size[0] // CELL) + cell[..., 0], NOWHERE)


class CellAttention(nn.Module):
    """Attention of a query over the cells of a feature map.

    Args:
        view: view of the camera.
        channels: channels of the feature map.
        width: size of a query.
        has_output: whether `forward` is used, which returns a token.
    """

    cell_coordinates: torch.Tensor

    def __init__(self, view: View, channels: int, width: int, *, has_output: bool = True) -> None:
        super().__init__()
        columns, rows = view.size[0] // CELL, view.size[1] // CELL
        y, x = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
        self.register_buffer("cell_coordinates", torch.stack([x, y], dim=-1).reshape(-1, 2), persistent=False)
        self.query_projection = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, channels))
        self.cell_projection = nn.Conv2d(channels, channels, 1)
        if has_output:
            self.output = nn.Linear(channels + 2, width)

    def logits(self, features: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
        """Return cell logits (B, Q, h w) for feature maps (B, C, h, w) and queries (B, Q, width)."""
        cells = self.cell_projection(features).flatten(2)
        scores = torch.einsum("bqc,bcn->bqn", self.query_projection(queries), cells).float()
        return scores / math.sqrt(cells.shape[1])

    def forward(self, features: torch.Tensor, query: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a token (B, width) and cell logits (B, h w).

        Args:
            features: (B, C, h, w) feature maps.
            query: (B, width).
        """
        logits = self.logits(features, query[:, None])[:, 0]
        probability = logits.softmax(dim=1)
        attended = torch.einsum("bn,bcn->bc", probability, features.flatten(2).float())
        return self.output(torch.cat([attended, probability @ self.cell_coordinates], dim=1)), logits


def cell_losses(logits: torch.Tensor, cells: torch.Tensor, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cross entropy of cell logits, and the number of predictions within one cell of a label.

    Args:
        logits: (..., N).
        cells: (..., I) labels, each of which counts as correct; `NOWHERE` outside the image.
        columns: number of cells per row.

    Returns:
        Two tensors (2,): the sum over queries with a label in the image, and the number of these queries.
    """
    visible = cells != NOWHERE
    has_label = visible.any(dim=-1)
    count = has_label.sum()
    log_probability = logits.log_softmax(dim=-1).gather(-1, cells.clamp(min=0)).masked_fill(~visible, -torch.inf)
    correct = torch.where(has_label[..., None], log_probability, 0.0).logsumexp(dim=-1)
    loss = -(correct * has_label).sum()
    with torch.no_grad():
        predicted = logits.argmax(dim=-1, keepdim=True)
        dx, dy = predicted % columns - cells % columns, predicted // columns - cells // columns
        close = ((torch.maximum(dx.abs(), dy.abs()) <= 1) & visible).any(dim=-1).sum()
    return torch.stack([loss, count]), torch.stack([close, count])


class Unproject(nn.Module):
    """Unprojection of image cells to points in space.

    Args:
        view: view of the camera.
        camera: calibration: ``intrinsic`` [fx, fy, cx, cy] in pixels of the view; ``mount`` (4, 4), pose of the OpenCV
            camera frame in the TCP frame if ``on_hand``, else in the arm's base frame.
        heights: mean and standard deviation of the points' heights in the arm's base frame, m.
        channels: channels of the feature maps.
        width: size of a query.
    """

    mount: torch.Tensor
    intrinsic: torch.Tensor
    cell_centers: torch.Tensor

    def __init__(self, view: View, camera: dict[str, Any], heights: tuple[float, float], channels: int, width: int):
        super().__init__()
        self._view, self._on_hand, self._heights = view, bool(camera["on_hand"]), heights
        columns = view.size[0] // CELL
        self.register_buffer("mount", torch.tensor(camera["mount"], dtype=torch.float32), persistent=False)
        self.register_buffer("intrinsic", torch.tensor(camera["intrinsic"], dtype=torch.float32), persistent=False)
        cells = torch.arange(columns * (view.size[1] // CELL))
        cell_centers = torch.stack([cells % columns, cells // columns], dim=-1) * CELL + CELL / 2
        self.register_buffer("cell_centers", cell_centers, persistent=False)
        self.offsets = nn.Conv2d(channels, 2, 1)
        self.height = nn.Sequential(nn.Linear(channels + width, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(
        self, features: torch.Tensor, query: torch.Tensor, logits: torch.Tensor, tcp: torch.Tensor, shift: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Locate the most probable cell of an attention map, without gradients.

        Args:
            features: (B, C, h, w) feature maps.
            query: (B, width).
            logits: (B, h w) of `CellAttention`.
            tcp: (B, 4, 4) TCP pose in the arm's base frame.
            shift: (B, 2) augmentation shift of the images, pixels.

        Returns:
            Points (B, 3) in the TCP frame, m; their features (B, `POINT_FEATURES`).
        """
        probability, cell = logits.detach().softmax(dim=1).max(dim=1)
        rows = torch.arange(len(cell), device=cell.device)
        cell_features = features.detach().flatten(2)[rows, :, cell]
        # Detached, not no_grad: under no_grad, autocast before torch 2.11 caches weights without gradients for `loss`
        offsets = self.offsets(features.detach()).flatten(2)[rows, :, cell].float()
        heights = self.height(torch.cat([cell_features, query.detach()], dim=1))[:, 0].float().detach()
        pixels = self.cell_centers[cell] + CELL * offsets.detach() - shift
        points = self.locate(pixels, heights * self._heights[1] + self._heights[0], tcp)
        coarse, fine = (points / _COARSE).clamp(-3, 3), (points / _FINE).clamp(-3, 3)
        return points, torch.cat([coarse, fine, probability[:, None]], dim=1)

    def locate(self, pixels: torch.Tensor, heights: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
        """Return points (B, 3) in the TCP frame, m.

        Args:
            pixels: (B, 2) in the view.
            heights: (B,) in the arm's base frame, m.
            tcp: (B, 4, 4) TCP pose in the arm's base frame.
        """
        flat = (pixels - self.intrinsic[2:]) / self.intrinsic[:2]
        ray = _rotate(self.mount[:3, :3], torch.cat([flat, torch.ones_like(flat[:, :1])], dim=1))
        origin = self.mount[:3, 3].expand_as(ray)
        if self._on_hand:
            ray, origin = _rotate(tcp[:, :3, :3], ray), _rotate(tcp[:, :3, :3], origin) + tcp[:, :3, 3]
        distance = ((heights - origin[:, 2]) / ray[:, 2].clamp(max=-_FLATTEST)).clamp(0, _FURTHEST)
        return _rotate(tcp[:, :3, :3].transpose(1, 2), origin + distance[:, None] * ray - tcp[:, :3, 3])

    def loss(
        self, features: torch.Tensor, queries: torch.Tensor, pixels: torch.Tensor, heights: torch.Tensor
    ) -> torch.Tensor:
        """Return the mean error () of Q queries.

        Args:
            features: (B, C, h, w) feature maps.
            queries: (B, Q, width).
            pixels: (B, Q, 2) labels; NaN or outside the view: no label.
            heights: (B, Q) labels in the arm's base frame, m.
        """
        cells = pixel_to_cell(pixels, self._view)
        visible, at = cells != NOWHERE, cells.clamp(min=0)
        offsets = self.offsets(features).flatten(2).float().gather(2, at[:, None].expand(-1, 2, -1)).transpose(1, 2)
        expected = (pixels.nan_to_num(0.0) - self.cell_centers[at]) / CELL
        cell_features = features.flatten(2).transpose(1, 2).gather(1, at[..., None].expand(-1, -1, features.shape[1]))
        predicted = self.height(torch.cat([cell_features, queries.detach()], dim=2))[..., 0].float()
        height_error = predicted * self._heights[1] + self._heights[0] - heights.nan_to_num(0.0)
        error = (offsets - expected).abs().sum(dim=-1) + height_error.abs() / _FINE
        return mean_of_sum(torch.stack([(error * visible).sum(), visible.sum()]))


def _rotate(rotations: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotate vectors (B, 3) by matrices (B, 3, 3) or (3, 3), in fp32: a bf16 matmul would round to 4 mm."""
    return (rotations * vectors[:, None]).sum(dim=-1)


def heights_in_base(points: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
    """Return the heights (B,) in the arm's base frame of points (B, 3) in the TCP frame, m."""
    return _rotate(tcp[:, :3, :3], points)[:, 2] + tcp[:, 2, 3]


def tcp_from_state(state: torch.Tensor) -> torch.Tensor:
    """Return the TCP pose (B, 4, 4) in the arm's base frame for proprioception (B, 10)."""
    first, second = state[:, 3:6], state[:, 6:9]
    rotation = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], device=state.device).expand(len(state), 1, 4)
    return torch.cat([torch.cat([rotation, state[:, :3, None]], dim=2), last], dim=1)
