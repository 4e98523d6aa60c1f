"""Locate the named object and the next key pose: the cell in each image, and the point in space.

The loss of the chunks alone teaches the network poorly which object an instruction names. Therefore auxiliary losses
train attention over the cells of each image. One label is the cell of the next key pose. The other labels are the cells
of all objects, each with an instruction that names it; they are known until the gripper command changes. An image shows
the direction of an object to a few millimetres, but not its distance. The point is therefore the intersection of the
ray through a pixel with the horizontal plane at a predicted height.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from robocas_ms3.baselines.small.config import CameraView
from robocas_ms3.baselines.training.metrics import mean_of_sum_and_count
from robocas_ms3.core.poses import Array, inverse, transform_points

CELL = 8
"""Side length of a cell in pixels."""
NOWHERE = -1
"""Cell index of a point outside the image."""
POINT_FEATURES = 7
"""Features per point: three coarse coordinates, three fine coordinates, probability of the cell."""
_NEAREST = 0.01  # smallest depth of a point that is projected, m
_FINE, _COARSE = 0.05, 0.3  # m, scales of the coordinates
_FURTHEST = 2.0  # greatest distance of a point along a ray, m
_FLATTEST = 0.03  # smallest downward component of a ray's direction; flatter rays are clamped to it


def project_points_to_view(
    points: NDArray[np.floating],
    camera_in_parent: Array,
    intrinsic: Array,
    stored_size: tuple[int, int],
    view: CameraView,
) -> NDArray[np.float32]:
    """Project points to pixel coordinates in the view of a camera.

    Args:
        points: (..., 3) points in the frame of the camera's parent, m.
        camera_in_parent: (4, 4) pose of the OpenCV camera frame in the frame of the parent.
        intrinsic: (4,) fx, fy, cx, cy of the images in the dataset, pixels.
        stored_size: width and height of the images in the dataset, pixels.
        view: view of the camera.

    Returns:
        Pixel coordinates x and y (..., 2), which may be outside the view; NaN for points behind the camera.
    """
    in_camera = transform_points(inverse(camera_in_parent), np.asarray(points, np.float64))
    depth = np.maximum(in_camera[..., 2:], _NEAREST)
    fraction = (in_camera[..., :2] / depth * intrinsic[:2] + intrinsic[2:]) / np.array(stored_size)
    left, top, right, bottom = np.array(view.crop_box()) / np.tile(view.image_size, 2)
    inside = (fraction - (left, top)) / (right - left, bottom - top)
    return np.where(in_camera[..., 2:] > _NEAREST, inside * view.size, np.nan).astype(np.float32)


def pixel_to_cell(pixels: torch.Tensor, view: CameraView) -> torch.Tensor:
    """Return the row-major cell indices (...) of pixel coordinates x and y (..., 2).

    The index of a pixel outside the view is `NOWHERE`.
    """
    size = torch.tensor(view.size, device=pixels.device)
    inside = ((pixels >= 0) & (pixels < size)).all(dim=-1)  # False for NaN
    cell = (pixels.nan_to_num(0.0) / CELL).floor().long()
    return torch.where(inside, cell[..., 1] * (view.size[0] // CELL) + cell[..., 0], NOWHERE)


class CellAttention(nn.Module):
    """Attention of a query over the image cells, which are the positions of a fine feature map.

    Args:
        view: view of the camera.
        channels: channels of the feature map.
        width: size of a query.
        has_output: whether to make the layer of `forward`; False if only `logits` is called.
    """

    cell_coordinates: torch.Tensor

    def __init__(self, view: CameraView, channels: int, width: int, *, has_output: bool = True) -> None:
        super().__init__()
        columns, rows = view.size[0] // CELL, view.size[1] // CELL
        y, x = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
        self.register_buffer("cell_coordinates", torch.stack([x, y], dim=-1).reshape(-1, 2), persistent=False)
        self.query_projection = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, channels))
        self.cell_projection = nn.Conv2d(channels, channels, 1)
        if has_output:
            self.output = nn.Linear(channels + 2, width)

    def logits(self, features: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
        """Return the attention logits of all cells (B, Q, h w).

        features: (B, C, h, w) feature maps. queries: (B, Q, width).
        """
        cells = self.cell_projection(features).flatten(2)
        scores = torch.einsum("bqc,bcn->bqn", self.query_projection(queries), cells).float()
        return scores / math.sqrt(cells.shape[1])

    def forward(self, features: torch.Tensor, query: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a token of the attended features (B, width), and the logits of all cells (B, h w).

        Args:
            features: (B, C, h, w) feature maps.
            query: (B, width).
        """
        logits = self.logits(features, query[:, None])[:, 0]
        probability = logits.softmax(dim=1)
        attended = torch.einsum("bn,bcn->bc", probability, features.flatten(2).float())
        return self.output(torch.cat([attended, probability @ self.cell_coordinates], dim=1)), logits


def compute_cell_losses(logits: torch.Tensor, cells: torch.Tensor, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cross entropy and the accuracy of predicted cells.

    They count only queries with a label in the image.

    A prediction is accurate if it is at most one cell away from a label.

    Args:
        logits: (..., N) attention logits of N cells per query.
        cells: (..., I) cell indices of the labels; each counts as correct. `NOWHERE`: outside the image.
        columns: number of cells per row of the image.

    Returns:
        Cross entropy (2,) and accuracy (2,), each as the sum over these queries and the number of these queries.
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
    """Unprojection of the attended image cell to a point in space.

    Args:
        view: view of the camera.
        camera: calibration of the camera. ``intrinsic``: [fx, fy, cx, cy] in pixels of the view. ``on_hand``: whether
            the camera is mounted on the hand. ``mount``: (4, 4) pose of the OpenCV camera frame, in the TCP frame if
            ``on_hand``, else in the arm's base frame.
        heights: mean and standard deviation of the heights of the labels in the arm's base frame, m.
        channels: channels of the feature maps.
        width: size of a query.
    """

    mount: torch.Tensor
    intrinsic: torch.Tensor
    cell_centers: torch.Tensor

    def __init__(
        self, view: CameraView, camera: dict[str, Any], heights: tuple[float, float], channels: int, width: int
    ):
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
        """Unproject the most probable cell of an attention map. The results have no gradients.

        Args:
            features: (B, C, h, w) feature maps.
            query: (B, width).
            logits: (B, h w) attention logits of `CellAttention`.
            tcp: (B, 4, 4) TCP pose in the arm's base frame.
            shift: (B, 2) augmentation shift of the images, pixels.

        Returns:
            Points (B, 3) in the TCP frame in m, and the features (B, `POINT_FEATURES`) that describe them.
        """
        probability, cell = logits.detach().softmax(dim=1).max(dim=1)
        rows = torch.arange(len(cell), device=cell.device)
        cell_features = features.detach().flatten(2)[rows, :, cell]
        # Detached, not no_grad: under no_grad, autocast before torch 2.11 caches weights without gradients for `loss`
        offsets = self.offsets(features.detach()).flatten(2)[rows, :, cell].float()
        heights = self.height(torch.cat([cell_features, query.detach()], dim=1))[:, 0].float().detach()
        pixels = self.cell_centers[cell] + CELL * offsets.detach() - shift
        points = self.unproject_pixels(pixels, heights * self._heights[1] + self._heights[0], tcp)
        coarse, fine = (points / _COARSE).clamp(-3, 3), (points / _FINE).clamp(-3, 3)
        return points, torch.cat([coarse, fine, probability[:, None]], dim=1)

    def unproject_pixels(self, pixels: torch.Tensor, heights: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
        """Return the points (B, 3) in the TCP frame, m, at which the rays through pixels reach given heights.

        Args:
            pixels: (B, 2) pixel coordinates x and y in the view.
            heights: (B,) heights of the points in the arm's base frame, m.
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
        """Return the unprojection loss (): the mean error over the queries that have a label in the view.

        The error is the L1 distance between predicted and labelled pixel, in cells, plus the height error in units of
        5 cm.

        Args:
            features: (B, C, h, w) feature maps.
            queries: (B, Q, width).
            pixels: (B, Q, 2) labelled pixels; NaN or outside the view: no label.
            heights: (B, Q) labelled heights in the arm's base frame, m.
        """
        cells = pixel_to_cell(pixels, self._view)
        visible, at = cells != NOWHERE, cells.clamp(min=0)
        offsets = self.offsets(features).flatten(2).float().gather(2, at[:, None].expand(-1, 2, -1)).transpose(1, 2)
        expected = (pixels.nan_to_num(0.0) - self.cell_centers[at]) / CELL
        cell_features = features.flatten(2).transpose(1, 2).gather(1, at[..., None].expand(-1, -1, features.shape[1]))
        predicted = self.height(torch.cat([cell_features, queries.detach()], dim=2))[..., 0].float()
        height_error = predicted * self._heights[1] + self._heights[0] - heights.nan_to_num(0.0)
        error = (offsets - expected).abs().sum(dim=-1) + height_error.abs() / _FINE
        return mean_of_sum_and_count(torch.stack([(error * visible).sum(), visible.sum()]))


def _rotate(rotations: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Return vectors (B, 3), rotated by matrices (B, 3, 3) or (3, 3).

    The computation is in fp32, because a bf16 matmul rounds positions to 4 mm.
    """
    return (rotations * vectors[:, None]).sum(dim=-1)


def compute_heights_in_base(points: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
    """Return the heights (B,) of points in the arm's base frame, m.

    points: (B, 3) points in the TCP frame, m. tcp: (B, 4, 4) TCP pose in the arm's base frame.
    """
    return _rotate(tcp[:, :3, :3], points)[:, 2] + tcp[:, 2, 3]


def decode_tcp_pose(state: torch.Tensor) -> torch.Tensor:
    """Return the TCP poses (B, 4, 4) in the arm's base frame, decoded from proprioception (B, 10)."""
    first, second = state[:, 3:6], state[:, 6:9]
    rotation = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], device=state.device).expand(len(state), 1, 4)
    return torch.cat([torch.cat([rotation, state[:, :3, None]], dim=2), last], dim=1)
