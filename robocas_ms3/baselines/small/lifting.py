"""From a pixel to a point: where in the TCP's frame that is which a pointer has found.

A camera says in which direction something lies, to a few millimetres, if its calibration is used; how far, it hardly
says. But what stands on a table is at a height that is soon learned, and cameras look down on it. So the point is where
the ray through a pixel meets the level of an estimated height. A network that has to learn all of that from poses
needs many more of them.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from robocas_ms3.baselines.small.config import View
from robocas_ms3.baselines.small.pointing import CELL, NOWHERE, cells_of
from robocas_ms3.baselines.training.metrics import mean_of_sum

SAID = 7
"""Numbers that are said of a point: coarse and fine coordinates, and how sure the pointer is."""
FAR = 0.15
"""m; what is nearer is in the log."""
_FINE, _COARSE = 0.05, 0.3  # m
_FURTHEST = 2.0  # m along a ray
_LEVEL = 0.03  # of a ray's direction: less steep ones are as if they were that steep


class Lift(nn.Module):
    """Finds points by one camera.

    Args:
        view: of its pictures.
        camera: ``intrinsic`` [fx, fy, cx, cy] in pixels of the view, ``mount`` (4, 4) OpenCV camera frame in the TCP
            where it is ``on_hand``, else in the arm's base.
        heights: mean and deviation of what is to be found, in the arm's base, m.
        channels: of the maps.
        width: of questions.
    """

    mount: torch.Tensor
    intrinsic: torch.Tensor
    middles: torch.Tensor

    def __init__(self, view: View, camera: dict[str, Any], heights: tuple[float, float], channels: int, width: int):
        super().__init__()
        self._view, self._on_hand, self._heights = view, bool(camera["on_hand"]), heights
        self._columns = view.size[0] // CELL
        self.register_buffer("mount", torch.tensor(camera["mount"], dtype=torch.float32), persistent=False)
        self.register_buffer("intrinsic", torch.tensor(camera["intrinsic"], dtype=torch.float32), persistent=False)
        cells = torch.arange(self._columns * (view.size[1] // CELL))
        middles = torch.stack([cells % self._columns, cells // self._columns], dim=-1) * CELL + CELL / 2
        self.register_buffer("middles", middles, persistent=False)
        self.offsets = nn.Conv2d(channels, 2, 1)
        self.height = nn.Sequential(nn.Linear(channels + width, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(
        self, fine: torch.Tensor, asked: torch.Tensor, logits: torch.Tensor, tcp: torch.Tensor, by: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What is found, by maps (B, C, h, w), questions (B, width), and a pointer's logits (B, h w) of them.

        Args:
            tcp: (B, 4, 4) in the arm's base.
            by: (B, 2) pixels that the pictures were shifted by.

        Returns:
            Points (B, 3) in the TCP's frame, m; what is said of them (B, `SAID`). Neither teaches the pointer anything.
        """
        share, cell = logits.detach().softmax(dim=1).max(dim=1)
        rows = torch.arange(len(cell), device=cell.device)
        what = fine.detach().flatten(2)[rows, :, cell]
        # not without gradients: torch's autocast, before 2.11, would keep the weights as they are for `loss`, too
        offsets = self.offsets(fine.detach()).flatten(2)[rows, :, cell].float()
        heights = self.height(torch.cat([what, asked.detach()], dim=1))[:, 0].float().detach()
        places = self.middles[cell] + CELL * offsets.detach() - by
        points = self._lifted(places, heights * self._heights[1] + self._heights[0], tcp)
        said = torch.cat([(points / _COARSE).clamp(-3, 3), (points / _FINE).clamp(-3, 3), share[:, None]], dim=1)
        return points, said

    def _lifted(self, places: torch.Tensor, heights: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
        flat = (places - self.intrinsic[2:]) / self.intrinsic[:2]
        ray = _turned(self.mount[:3, :3], torch.cat([flat, torch.ones_like(flat[:, :1])], dim=1))
        start = self.mount[:3, 3].expand_as(ray)
        if self._on_hand:
            ray, start = _turned(tcp[:, :3, :3], ray), _turned(tcp[:, :3, :3], start) + tcp[:, :3, 3]
        far = ((heights - start[:, 2]) / ray[:, 2].clamp(max=-_LEVEL)).clamp(0, _FURTHEST)
        return _turned(tcp[:, :3, :3].transpose(1, 2), start + far[:, None] * ray - tcp[:, :3, 3])

    def loss(
        self, fine: torch.Tensor, asked: torch.Tensor, places: torch.Tensor, heights: torch.Tensor
    ) -> torch.Tensor:
        """Error where places (B, Q, 2) and heights (B, Q), in the arm's base, are known and seen, of Q questions."""
        cells = cells_of(places, self._view)
        shown, at = cells != NOWHERE, cells.clamp(min=0)
        offsets = self.offsets(fine).flatten(2).float().gather(2, at[:, None].expand(-1, 2, -1)).transpose(1, 2)
        meant = (places.nan_to_num(0.0) - self.middles[at]) / CELL
        what = fine.flatten(2).transpose(1, 2).gather(1, at[..., None].expand(-1, -1, fine.shape[1]))
        found = self.height(torch.cat([what, asked.detach()], dim=2))[..., 0].float()
        low = found * self._heights[1] + self._heights[0] - heights.nan_to_num(0.0)
        wrong = (offsets - meant).abs().sum(dim=-1) + low.abs() / _FINE
        return mean_of_sum(torch.stack([(wrong * shown).sum(), shown.sum()]))


def _turned(turns: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Vectors (B, 3) turned by (B, 3, 3) or (3, 3); not as a product of matrices, which bf16 would round to 4 mm."""
    return (turns * vectors[:, None]).sum(dim=-1)


def heights_of(points: torch.Tensor, tcp: torch.Tensor) -> torch.Tensor:
    """(B,) in the arm's base, of points (B, 3) in the TCP's frame."""
    return _turned(tcp[:, :3, :3], points)[:, 2] + tcp[:, 2, 3]


def tcp_of(state: torch.Tensor) -> torch.Tensor:
    """(B, 4, 4) of what the arm feels (B, 10), see `chunks.state_of`."""
    first, second = state[:, 3:6], state[:, 6:9]
    turn = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], device=state.device).expand(len(state), 1, 4)
    return torch.cat([torch.cat([turn, state[:, :3, None]], dim=2), last], dim=1)
