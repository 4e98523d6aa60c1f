"""The network of `small`: a convolutional network per camera, and a transformer over their feature maps.

Its queries, one per step of the chunk and one for the next key pose, attend to feature maps at a sixteenth of the
images' size. Language and proprioception are tokens, and scale and shift the channels (FiLM, Perez et al. 2018). A
pointer per image looks at finer maps, for where the gripper will close or open next; the features there are a token
too. These maps do not depend on the query, so that in training each image answers for every object in it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.chunks import ROW, Scale, chunk_losses
from robocas_ms3.baselines.small.config import SmallConfig, View
from robocas_ms3.baselines.small.localization import (
    CELL,
    NOWHERE,
    POINT_FEATURES,
    Lift,
    Pointer,
    cells_of,
    heights_of,
    pointing_losses,
    tcp_of,
)
from robocas_ms3.baselines.training.metrics import mean_of_sum

_WORDS, _STATE = 384, 10
_FAR = 0.15  # m; closer points have a metric of their own
Maps = dict[str, tuple[torch.Tensor, torch.Tensor]]
"""By camera the maps of `Eye`."""


class Block(nn.Module):
    """A residual block (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.second = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norms = nn.ModuleList([nn.GroupNorm(8, outputs), nn.GroupNorm(8, outputs)])
        self.short = nn.Identity() if stride == 1 and inputs == outputs else nn.Conv2d(inputs, outputs, 1, stride)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return (B, C, h, w) for (B, c, H, W)."""
        inner = F.relu(self.norms[0](self.first(features)))
        return F.relu(self.norms[1](self.second(inner)) + self.short(features))


class Eye(nn.Module):
    """Tokens of a camera's images, and a finer map for its pointer."""

    def __init__(self, view: View, channels: int, width: int, *, lifts: bool) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, channels, 4, 4)
        self.norm = nn.GroupNorm(8, channels)
        self.fine = nn.Sequential(Block(channels, channels, 1), Block(channels, 2 * channels, 2))
        self.coarse = Block(2 * channels, 4 * channels, 2)
        self.down = nn.Conv2d(4 * channels, 2 * channels, 1)
        self.pointer = Pointer(view, 2 * channels, width)
        if lifts:
            self.namer = Pointer(view, 2 * channels, width, tells=False)
        self.film, self.project = nn.Linear(width, 8 * channels), nn.Conv2d(4 * channels, width, 1)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)
        self.mark = nn.Parameter(torch.randn(width))
        self._grid = view.size[1] // CELL, view.size[0] // CELL
        self.places = nn.Parameter(torch.randn(view.size[0] * view.size[1] // 256, width) * 0.2)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return coarse maps (B, 4 channels, h / 16, w / 16) and fine ones (B, 2 channels, h / 8, w / 8)."""
        fine = self.fine(F.relu(self.norm(self.stem(images))))
        coarse = self.coarse(fine)
        return coarse, fine + F.interpolate(self.down(coarse), scale_factor=2)

    def tell(self, maps: tuple[torch.Tensor, torch.Tensor], query: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return tokens for a query (B, width), and logits of the cells (B, h w / 64) that it points to.

        Tokens are (B, h w / 256 + 1, width), marked where the query points; the last one has the features there.
        """
        coarse, fine = maps
        pointed, logits = self.pointer(fine, query)
        scale, shift = self.film(query)[:, :, None, None].chunk(2, dim=1)
        tokens = self.project(F.relu(coarse * (1 + scale) + shift)).flatten(2).transpose(1, 2) + self.places
        there = 4 * F.avg_pool2d(logits.softmax(dim=1).reshape(-1, 1, *self._grid), 2)
        tokens = tokens + there.flatten(2).transpose(1, 2) * self.mark
        return torch.cat([tokens, pointed[:, None]], dim=1), logits


class Prediction(NamedTuple):
    """What the network predicts for a batch.

    Attributes:
        chunk: (B, K, 10) normalised, with logits of the commands.
        key: (B, 9) normalised.
        state: (B, width) encoded proprioception.
        query: (B, width) that, and the encoded instruction.
        cells: logits (B, h w / 64) of where the query points, by camera.
        points: (B, 3) located there in the TCP's frame, m, by camera; empty without ``lift``.
    """

    chunk: torch.Tensor
    key: torch.Tensor
    state: torch.Tensor
    query: torch.Tensor
    cells: dict[str, torch.Tensor]
    points: dict[str, torch.Tensor]


class SmallModel(nn.Module):
    """Predicts chunks (B, K, 10) and key poses (B, 9)."""

    def __init__(self, config: SmallConfig, facts: dict[str, Any]) -> None:
        super().__init__()
        self.config, width = config, config.width
        self.chunk_scale, self.key_scale = Scale(**facts["chunk"]), Scale(**facts["keys"])
        self.word_scale = Scale(**facts["words"])
        self.words = nn.Sequential(nn.Linear(_WORDS, width), nn.ReLU(), nn.Dropout(config.dropout))
        self.state = nn.Sequential(nn.Linear(_STATE, width), nn.ReLU(), nn.Linear(width, width))
        self.eyes = nn.ModuleDict(
            {camera: Eye(view, config.channels, width, lifts=config.lift) for camera, view in config.views.items()}
        )
        self.queries = nn.Parameter(torch.randn(config.chunk + 1, width) * 0.2)
        layer = nn.TransformerDecoderLayer(
            width, config.heads, 4 * width, config.dropout, batch_first=True, norm_first=True
        )
        self.decoder = nn.TransformerDecoder(layer, config.layers, nn.LayerNorm(width))
        if config.lift:
            self.lifts = nn.ModuleDict()  # of where the gripper will close or open next
            self.stands = nn.ModuleDict()  # of where the object stands
            heights = facts["heights"]["mean"], facts["heights"]["deviation"]
            for camera, view in config.views.items():
                for lifts in (self.lifts, self.stands):
                    lifts[camera] = Lift(view, facts["calibration"][camera], heights, 2 * config.channels, width)
            features = 2 * POINT_FEATURES * len(config.views)
            self.aim = nn.Sequential(nn.Linear(features, width), nn.ReLU(), nn.Linear(width, width))
        self.out, self.key_out = nn.Linear(width, ROW), nn.Linear(width, 9)

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Return the losses, see `chunk_losses` and `pointing_losses`; those for other instructions come last."""
        images, places, shifts = {}, {}, {}
        for camera in self.config.views:
            image, by = self._shift(batch[camera])
            images[camera], shifts[camera] = self._light(image), by
            places[camera] = (batch[f"{camera}_place"] + by, batch[f"{camera}_places"] + by[:, None])
        maps = self._look(images)
        words, asked = self._hear(batch["words"]), self._hear(batch["asked"])
        found = self._predict(maps, words, batch["state"], shifts)
        losses = chunk_losses(self, batch, found.chunk, found.key)
        kinds = batch["kinds"]
        alike = (kinds[:, :, None] == kinds[:, None, :]) & (kinds >= 0)[:, :, None]
        for camera, view in self.config.views.items():
            columns, (place, others) = view.size[0] // CELL, places[camera]
            loss, right = pointing_losses(found.cells[camera], cells_of(place, view)[:, None], columns)
            eye: Any = self.eyes[camera]
            fine = maps[camera][1]
            if self.config.lift:
                logits = eye.namer.logits(fine, asked)
            else:
                logits = eye.pointer.logits(fine, asked + found.state.detach()[:, None])
            standing = cells_of(others, view)[:, None].where(alike, NOWHERE)
            more, named = pointing_losses(logits, standing, columns)
            pointing = self.config.point_weight * mean_of_sum(loss) + self.config.name_weight * mean_of_sum(more)
            losses["loss"] = losses["loss"] + pointing
            losses |= {f"{camera}_point": loss, f"{camera}_found": right}
            losses |= {f"{camera}_name": more, f"{camera}_named": named}
            if self.config.lift:
                losses |= self._lift_losses(batch, camera, maps, found, asked, places[camera])
                losses["loss"] = losses["loss"] + self.config.lift_weight * losses[f"{camera}_lift"]
        return losses

    def act(self, batch: Batch) -> torch.Tensor:
        """Return chunks (B, K, 10): poses, and probabilities that the gripper opens."""
        maps = self._look({camera: self._light(batch[camera]) for camera in self.config.views})
        shifts = dict.fromkeys(maps, torch.zeros(1, 2, device=batch["state"].device))
        chunk = self._predict(maps, self._hear(batch["words"]), batch["state"], shifts).chunk
        return torch.cat([self.chunk_scale.back(chunk[..., :9]), chunk[..., 9:].sigmoid()], dim=-1)

    def _lift_losses(
        self,
        batch: Batch,
        camera: str,
        maps: Maps,
        found: Prediction,
        asked: torch.Tensor,
        places: tuple[torch.Tensor, torch.Tensor],
    ) -> dict[str, torch.Tensor]:
        """Return the losses of located points, and the error in mm of the next key pose if that is near."""
        lift: Any = self.lifts[camera]
        stands: Any = self.stands[camera]
        fine = maps[camera][1]
        next_height = heights_of(batch["key"][:, :3], tcp_of(batch["state"]))
        own = lift.loss(fine, found.query[:, None], places[0][:, None], next_height[:, None])
        known = batch["kinds"] >= 0
        others = places[1].where(known[..., None], torch.nan)
        error = (found.points[camera] - batch["key"][:, :3]).norm(dim=1)
        near = (batch["key"][:, :3].norm(dim=1) < _FAR) & (cells_of(places[0], self.config.views[camera]) != NOWHERE)
        return {
            f"{camera}_lift": own + stands.loss(fine, asked, others, batch["heights"]),
            f"{camera}_lift_mm": torch.stack([1000 * (error * near).sum(), near.sum()]),
        }

    def _hear(self, words: torch.Tensor) -> torch.Tensor:
        return self.words(self.word_scale(words).clamp(-3, 3))

    def _look(self, images: Batch) -> Maps:
        return {camera: eye(images[camera]) for camera, eye in self.eyes.items()}

    def _predict(self, maps: Maps, words: torch.Tensor, state: torch.Tensor, shifts: Batch) -> Prediction:
        """Predict from maps, encoded words (B, width) and proprioception (B, 10)."""
        encoded = self.state(state)
        aims = query = words + encoded
        tokens, cells, points, features = {}, {}, {}, []
        for camera, (coarse, fine) in maps.items():
            eye: Any = self.eyes[camera]
            tokens[camera], cells[camera] = eye.tell((coarse, fine), query)
            if self.config.lift:
                named = eye.namer.logits(fine, words[:, None])[:, 0]
                tcp, shift = tcp_of(state), shifts[camera]
                points[camera], key = self.lifts[camera](fine, query, cells[camera], tcp, shift)
                _, stands = self.stands[camera](fine, words, named, tcp, shift)
                features += [key, stands]
        if self.config.lift:
            aims = query + self.aim(torch.cat(features, dim=1))
        memory = torch.cat([*tokens.values(), words[:, None], encoded[:, None]], dim=1)
        decoded = self.decoder(self.queries + aims[:, None], memory)
        chunk, next_key = self.out(decoded[:, :-1]).float(), self.key_out(decoded[:, -1]).float()
        return Prediction(chunk, next_key, encoded, query, cells, points)

    def _shift(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return images (B, h, w, 3), in training shifted at random, and by how much: (B, 2) or (1, 2) pixels."""
        if not (self.training and self.config.shift):
            return images, torch.zeros(1, 2, device=images.device)
        most = self.config.shift
        by = torch.randint(-most, most + 1, (len(images), 2), device=images.device)
        return shift_images(images, by), by

    def _light(self, images: torch.Tensor) -> torch.Tensor:
        """Return (B, 3, h, w) around 0 for (B, h, w, 3) uint8; in training with random brightness and contrast."""
        scaled = images.permute(0, 3, 1, 2).contiguous().float()  # norms are slow where channels are last
        if not (self.training and self.config.brightness):
            return scaled / 127.5 - 1
        contrast, light = self.config.brightness * (2 * torch.rand(2, len(scaled), 1, 1, 1, device=scaled.device) - 1)
        return scaled.mul_((1 + contrast) / 127.5).add_(light - 1 - contrast)  # (x / 127.5 - 1) (1 + contrast) + light


def shift_images(images: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Return images (B, h, w, C) shifted by (B, 2) pixels right and down; pixels at the edge are repeated."""
    count, height, width, _ = images.shape
    device = images.device
    rows = (torch.arange(height, device=device) - by[:, 1:]).clamp(0, height - 1)  # (B, h)
    columns = (torch.arange(width, device=device) - by[:, :1]).clamp(0, width - 1)
    batch = torch.arange(count, device=device)[:, None, None]
    return images[batch, rows[:, :, None], columns[:, None, :]]
