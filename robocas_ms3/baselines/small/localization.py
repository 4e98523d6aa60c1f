"""Find what an instruction names: its cell in an image, and by the calibration of the camera its point in space.

A network hardly learns from the error of a chunk to find the object that is meant until the hand is there. So it also
points into the images. Labels are where the TCP is when the gripper command changes next, and, until then, the objects
of the layout, for the instructions of other episodes. A camera tells the direction of an object to a few millimetres,
and hardly its distance; but objects stand on a table, so the point is where the ray through a pixel meets the level of
an estimated height. A network that has to learn all of that from poses needs many more of them.
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
"""Side of a cell in pixels."""
NOWHERE = -1
"""Cell of a point outside of the image."""
POINT_FEATURES = 7
"""Features of a point: coarse and fine coordinates, and how sure the pointer is."""
_NEAREST = 0.01  # m before the camera
_FINE, _COARSE = 0.05, 0.3  # m
_FURTHEST = 2.0  # m along a ray
_FLATTEST = 0.03  # of the height of a ray's direction: flatter rays are as if they were that steep


def project_points(
    points: NDArray[np.floating], camera: Array, intrinsic: Array, stored: tuple[int, int], view: View
) -> NDArray[np.float32]:
    """Return x and y (..., 2) of points in pixels of a view, inside of it or not; NaN: behind the camera.

    Args:
        points: (..., 3) in the camera's parent, m.
        camera: (4, 4) OpenCV camera frame in that parent.
        intrinsic: (4,) fx, fy, cx, cy of the stored images, in pixels.
        stored: width and height of those.
        view: of the camera.
    """
    seen = transform_points(inverse(camera), np.asarray(points, np.float64))
    depth = np.maximum(seen[..., 2:], _NEAREST)
    share = (seen[..., :2] / depth * intrinsic[:2] + intrinsic[2:]) / np.array(stored)
    left, top, right, bottom = np.array(view.box()) / np.tile(view.rendered, 2)
    inside = (share - (left, top)) / (right - left, bottom - top)
    return np.where(seen[..., 2:] > _NEAREST, inside * view.size, np.nan).astype(np.float32)


def cells_of(places: torch.Tensor, view: View) -> torch.Tensor:
    """Return the cells (...) of a view, row by row, of places (..., 2) in pixels; `NOWHERE`: outside."""
    size = torch.tensor(view.size, device=places.device)
    inside = ((places >= 0) & (places < size)).all(dim=-1)  # NaN is not
    cell = (places.nan_to_num(0.0) / CELL).floor().long()
    return torch.where(inside, cell[..., 1] * (view.size[0] // CELL) + cell[..., 0], NOWHERE)


class Pointer(nn.Module):
    """Compares each cell of a feature map with a query."""

    places: torch.Tensor

    def __init__(self, view: View, channels: int, width: int, *, tells: bool = True) -> None:
        super().__init__()
        columns, rows = view.size[0] // CELL, view.size[1] // CELL
        y, x = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
        self.register_buffer("places", torch.stack([x, y], dim=-1).reshape(-1, 2), persistent=False)
        self.wanted = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, channels))
        self.offered = nn.Conv2d(channels, channels, 1)
        if tells:
            self.tell = nn.Linear(channels + 2, width)

    def logits(self, features: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
        """Return logits (B, Q, h w) of the cells, for maps (B, C, h, w) and queries (B, Q, width)."""
        offered = self.offered(features).flatten(2)
        return torch.einsum("bqc,bcn->bqn", self.wanted(queries), offered).float() / math.sqrt(offered.shape[1])

    def forward(self, features: torch.Tensor, query: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return an answer (B, width) and logits (B, h w), for maps (B, C, h, w) and a query (B, width)."""
        logits = self.logits(features, query[:, None])[:, 0]
        share = logits.softmax(dim=1)
        what = torch.einsum("bn,bcn->bc", share, features.flatten(2).float())
        return self.tell(torch.cat([what, share @ self.places], dim=1)), logits


def pointing_losses(logits: torch.Tensor, cells: torch.Tensor, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cross entropy of the cells, and how many were found to one cell.

    Args:
        logits: (..., N).
        cells: (..., I) right answers, any of which counts; `NOWHERE`: outside of the image.
        columns: of the cells.

    Returns:
        Two (2,): a sum over the queries with an answer in the image, and the number of these.
    """
    shown = cells != NOWHERE
    asked = shown.any(dim=-1)
    count = asked.sum()
    share = logits.log_softmax(dim=-1).gather(-1, cells.clamp(min=0)).masked_fill(~shown, -torch.inf)
    right = torch.where(asked[..., None], share, 0.0).logsumexp(dim=-1)
    loss = -(right * asked).sum()
    with torch.no_grad():
        found = logits.argmax(dim=-1, keepdim=True)
        off = torch.maximum((found % columns - cells % columns).abs(), (found // columns - cells // columns).abs())
        close = ((off <= 1) & shown).any(dim=-1).sum()
    return torch.stack([loss, count]), torch.stack([close, count])


class Lift(nn.Module):
    """Locates points in space from their cells in the images of a camera.

    Args:
        view: of the images.
        camera: ``intrinsic`` [fx, fy, cx, cy] in pixels of the view, ``mount`` (4, 4) OpenCV camera frame in the TCP
            if it is ``on_hand``, else in the arm's base.
        heights: mean and deviation of the heights of points, in the arm's base, m.
        channels: of the maps.
        width: of queries.
    """

    mount: torch.Tensor
    intrinsic: torch.Tensor
    middles: torch.Tensor

    def __init__(self, view: View, camera: dict[str, Any], heights: tuple[float, float], channels: int, width: int):
        super().__init__()
        self._view, self._on_hand, self._heights = view, bool(camera["on_hand"]), heights
        columns = view.size[0] // CELL
        self.register_buffer("mount", torch.tensor(camera["mount"], dtype=torch.float32), persistent=False)
        self.register_buffer("intrinsic", torch.tensor(camera["intrinsic"], dtype=torch.float32), persistent=False)
        cells = torch.arange(columns * (view.size[1] // CELL))
        middles = torch.stack([cells % columns, cells // columns], dim=-1) * CELL + CELL / 2
        self.register_buffer("middles", middles, persistent=False)
        self.offsets = nn.Conv2d(channels, 2, 1)
        self.height = nn.Sequential(nn.Linear(channels + width, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(
        self, features: torch.Tensor, query: torch.Tensor, logits: torch.Tensor, tcp: torch.Tensor, shift: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Locate the likeliest cell of a pointer; no gradient flows from here.

        Args:
            features: (B, C, h, w) maps.
            query: (B, width).
            logits: (B, h w) of the pointer.
            tcp: (B, 4, 4) in the arm's base.
            shift: (B, 2) pixels that the images were shifted by.

        Returns:
            Points (B, 3) in the TCP's frame, m; their features (B, `POINT_FEATURES`).
        """
        share, cell = logits.detach().softmax(dim=1).max(dim=1)
        rows = torch.arange(len(cell), device=cell.device)
        what = features.detach().flatten(2)[rows, :, cell]
        # Detached, not under no_grad: there torch's autocast, before 2.11, would cache the weights for `loss` too
        offsets = self.offsets(features.detach()).flatten(2)[rows, :, cell].float()
        heights = self.height(torch.cat([what, query.detach()], dim=1))[:, 0].float().detach()
        places = self.middles[cell] + CELL * offsets.detach() - shift
        points = self.locate(places, heights * self._heights[1] + self._heights[0], tcp)
        coarse, fine = (points / _COARSE).clamp(-3, 3), (points / _FINE).clamp(-3, 3)
        return points, torch.cat([coarse, fine, share[:, None]], dim=1)

    def locate(self, places: torch.Tensor, heights: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
        """Return points (B, 3) in the TCP's frame, from pixels (B, 2) and heights (B,) in the arm's base."""
        flat = (places - self.intrinsic[2:]) / self.intrinsic[:2]
        ray = _rotate(self.mount[:3, :3], torch.cat([flat, torch.ones_like(flat[:, :1])], dim=1))
        start = self.mount[:3, 3].expand_as(ray)
        if self._on_hand:
            ray, start = _rotate(tcp[:, :3, :3], ray), _rotate(tcp[:, :3, :3], start) + tcp[:, :3, 3]
        far = ((heights - start[:, 2]) / ray[:, 2].clamp(max=-_FLATTEST)).clamp(0, _FURTHEST)
        return _rotate(tcp[:, :3, :3].transpose(1, 2), start + far[:, None] * ray - tcp[:, :3, 3])

    def loss(
        self, features: torch.Tensor, queries: torch.Tensor, places: torch.Tensor, heights: torch.Tensor
    ) -> torch.Tensor:
        """Return the error () for Q queries with known places (B, Q, 2) in the image and heights (B, Q) in the base."""
        cells = cells_of(places, self._view)
        shown, at = cells != NOWHERE, cells.clamp(min=0)
        offsets = self.offsets(features).flatten(2).float().gather(2, at[:, None].expand(-1, 2, -1)).transpose(1, 2)
        meant = (places.nan_to_num(0.0) - self.middles[at]) / CELL
        what = features.flatten(2).transpose(1, 2).gather(1, at[..., None].expand(-1, -1, features.shape[1]))
        found = self.height(torch.cat([what, queries.detach()], dim=2))[..., 0].float()
        low = found * self._heights[1] + self._heights[0] - heights.nan_to_num(0.0)
        wrong = (offsets - meant).abs().sum(dim=-1) + low.abs() / _FINE
        return mean_of_sum(torch.stack([(wrong * shown).sum(), shown.sum()]))


def _rotate(turns: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotate vectors (B, 3) by (B, 3, 3) or (3, 3); a product of matrices would be rounded by bf16 to 4 mm."""
    return (turns * vectors[:, None]).sum(dim=-1)


def heights_of(points: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
    """Return the heights (B,) in the arm's base of points (B, 3) in the TCP's frame."""
    return _rotate(tcp[:, :3, :3], points)[:, 2] + tcp[:, 2, 3]


def tcp_of(state: torch.Tensor) -> torch.Tensor:
    """Return the TCP (B, 4, 4) in the arm's base from proprioception (B, 10), see `chunks.state_of`."""
    first, second = state[:, 3:6], state[:, 6:9]
    turn = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], device=state.device).expand(len(state), 1, 4)
    return torch.cat([torch.cat([turn, state[:, :3, None]], dim=2), last], dim=1)
