"""The network of `small`: a convolutional net a camera, and a transformer that asks them what it needs to know.

Feature maps at a sixteenth of the pictures' size are what its queries look at: one query a step of the chunk, one for
the next key pose. Language and the arm's state are part of what is looked at, and scale and shift its channels (FiLM,
Perez et al. 2018). Finer maps are what a pointer in each picture looks at, for where the gripper will close or open
next; what is there is a token too. These maps do not depend on what is asked, so that in training each picture
answers for every object in it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.chunks import ROW, Scale, chunk_losses
from robocas_ms3.baselines.small.config import SmallConfig, View
from robocas_ms3.baselines.small.lifting import FAR, SAID, Lift, heights_of, tcp_of
from robocas_ms3.baselines.small.pointing import CELL, NOWHERE, Pointer, cells_of, pointing_losses
from robocas_ms3.baselines.training.metrics import mean_of_sum

_WORDS, _STATE = 384, 10
Maps = dict[str, tuple[torch.Tensor, torch.Tensor]]
"""By camera what `Eye` makes of pictures."""


class Block(nn.Module):
    """A residual block (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.second = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norms = nn.ModuleList([nn.GroupNorm(8, outputs), nn.GroupNorm(8, outputs)])
        self.short = nn.Identity() if stride == 1 and inputs == outputs else nn.Conv2d(inputs, outputs, 1, stride)

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        """(B, C, h, w) of (B, c, H, W)."""
        inner = F.relu(self.norms[0](self.first(seen)))
        return F.relu(self.norms[1](self.second(inner)) + self.short(seen))


class Eye(nn.Module):
    """What a camera's pictures show: tokens, and a finer map for its pointer."""

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

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, 4 channels, h / 16, w / 16) and (B, 2 channels, h / 8, w / 8) maps of pictures (B, 3, h, w) around 0."""
        fine = self.fine(F.relu(self.norm(self.stem(pictures))))
        coarse = self.coarse(fine)
        return coarse, fine + F.interpolate(self.down(coarse), scale_factor=2)

    def tell(self, maps: tuple[torch.Tensor, torch.Tensor], asked: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What a question (B, width) gets to know of maps.

        Returns:
            Tokens (B, h w / 256 + 1, width), marked where it points, of which the last is what is there; logits of
            cells (B, h w / 64).
        """
        coarse, fine = maps
        pointed, logits = self.pointer(fine, asked)
        scale, shift = self.film(asked)[:, :, None, None].chunk(2, dim=1)
        tokens = self.project(F.relu(coarse * (1 + scale) + shift)).flatten(2).transpose(1, 2) + self.places
        there = 4 * F.avg_pool2d(logits.softmax(dim=1).reshape(-1, 1, *self._grid), 2)
        tokens = tokens + there.flatten(2).transpose(1, 2) * self.mark
        return torch.cat([tokens, pointed[:, None]], dim=1), logits


class Thought(NamedTuple):
    """What comes of a look.

    Attributes:
        chunk: (B, K, 10) normalised, with commands' logits.
        key: (B, 9) normalised.
        state: (B, width) what the arm feels.
        asked: (B, width) and what it was told.
        cells: logits (B, h w / 64) of where it points, by camera.
        points: (B, 3) of that in the TCP's frame, m, by camera; empty without `lifting`.
    """

    chunk: torch.Tensor
    key: torch.Tensor
    state: torch.Tensor
    asked: torch.Tensor
    cells: dict[str, torch.Tensor]
    points: dict[str, torch.Tensor]


class SmallModel(nn.Module):
    """See the module; predicts chunks (B, K, 10) and key poses (B, 9)."""

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
                for of in (self.lifts, self.stands):
                    of[camera] = Lift(view, facts["calibration"][camera], heights, 2 * config.channels, width)
            self.aim = nn.Sequential(nn.Linear(2 * SAID * len(config.views), width), nn.ReLU(), nn.Linear(width, width))
        self.out, self.key_out = nn.Linear(width, ROW), nn.Linear(width, 9)

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Losses, see `chunk_losses` and `pointing_losses`; those of other questions than the instruction's last."""
        pictures, places, moves = {}, {}, {}
        for camera in self.config.views:
            seen = batch[camera]
            by = self._shifts(seen)
            pictures[camera] = self._lit(shifted(seen, by) if by is not None else seen)
            moved = moves[camera] = by if by is not None else torch.zeros(1, 2, device=seen.device)
            places[camera] = (batch[f"{camera}_place"] + moved, batch[f"{camera}_places"] + moved[:, None])
        maps, felt = self._look(pictures), batch["state"]
        words, asked = self._hear(batch["words"]), self._hear(batch["asked"])
        came = self._think(maps, words, felt, moves)
        found = chunk_losses(self, batch, came.chunk, came.key)
        kinds = batch["kinds"]
        alike = (kinds[:, :, None] == kinds[:, None, :]) & (kinds >= 0)[:, :, None]
        for camera, view in self.config.views.items():
            columns, (place, others) = view.size[0] // CELL, places[camera]
            loss, right = pointing_losses(came.cells[camera], cells_of(place, view)[:, None], columns)
            eye: Any = self.eyes[camera]
            fine = maps[camera][1]
            if self.config.lift:
                logits = eye.namer.logits(fine, asked)
            else:
                logits = eye.pointer.logits(fine, asked + came.state.detach()[:, None])
            standing = cells_of(others, view)[:, None].where(alike, NOWHERE)
            more, named = pointing_losses(logits, standing, columns)
            pointing = self.config.point_weight * mean_of_sum(loss) + self.config.name_weight * mean_of_sum(more)
            found["loss"] = found["loss"] + pointing
            found |= {f"{camera}_point": loss, f"{camera}_found": right}
            found |= {f"{camera}_name": more, f"{camera}_named": named}
            if self.config.lift:
                found |= self._locating(batch, camera, fine, came, asked, places[camera])
                found["loss"] = found["loss"] + self.config.lift_weight * found[f"{camera}_lift"]
        return found

    def _locating(
        self,
        batch: Batch,
        camera: str,
        fine: torch.Tensor,
        came: Thought,
        asked: torch.Tensor,
        places: tuple[torch.Tensor, torch.Tensor],
    ) -> dict[str, torch.Tensor]:
        """Losses of where a camera says that things are, and its error of what is next where that is near, in mm."""
        lift: Any = self.lifts[camera]
        stands: Any = self.stands[camera]
        next_height = heights_of(batch["key"][:, :3], tcp_of(batch["state"]))
        own = lift.loss(fine, came.asked[:, None], places[0][:, None], next_height[:, None])
        known = batch["kinds"] >= 0
        others = places[1].where(known[..., None], torch.nan)
        error = (came.points[camera] - batch["key"][:, :3]).norm(dim=1)
        near = (batch["key"][:, :3].norm(dim=1) < FAR) & (cells_of(places[0], self.config.views[camera]) != NOWHERE)
        return {
            f"{camera}_lift": own + stands.loss(fine, asked, others, batch["heights"]),
            f"{camera}_lift_mm": torch.stack([1000 * (error * near).sum(), near.sum()]),
        }

    def act(self, batch: Batch) -> torch.Tensor:
        """(B, K, 10) chunks: poses as they are, commands as shares, 1 = open."""
        maps = self._look({camera: self._lit(batch[camera]) for camera in self.config.views})
        still = dict.fromkeys(maps, torch.zeros(1, 2, device=batch["state"].device))
        chunk = self._think(maps, self._hear(batch["words"]), batch["state"], still).chunk
        return torch.cat([self.chunk_scale.back(chunk[..., :9]), chunk[..., 9:].sigmoid()], dim=-1)

    def _hear(self, words: torch.Tensor) -> torch.Tensor:
        return self.words(self.word_scale(words).clamp(-3, 3))

    def _look(self, pictures: Batch) -> Maps:
        return {camera: eye(pictures[camera]) for camera, eye in self.eyes.items()}

    def _think(self, maps: Maps, words: torch.Tensor, felt: torch.Tensor, moves: Batch) -> Thought:
        """What comes of maps, words (B, width) and what the arm feels (B, 10), of pictures shifted by ``moves``."""
        state = self.state(felt)
        aims = asked = words + state
        tokens, cells, points, said = {}, {}, {}, []
        for camera, of in maps.items():
            eye: Any = self.eyes[camera]
            tokens[camera], cells[camera] = eye.tell(of, asked)
            if self.config.lift:
                named = eye.namer.logits(of[1], words[:, None])[:, 0]
                where, by = tcp_of(felt), moves[camera]
                points[camera], key = self.lifts[camera](of[1], asked, cells[camera], where, by)
                _, stands = self.stands[camera](of[1], words, named, where, by)
                said += [key, stands]
        if self.config.lift:
            aims = asked + self.aim(torch.cat(said, dim=1))
        memory = torch.cat([*tokens.values(), words[:, None], state[:, None]], dim=1)
        thought = self.decoder(self.queries + aims[:, None], memory)
        chunk, next_key = self.out(thought[:, :-1]).float(), self.key_out(thought[:, -1]).float()
        return Thought(chunk, next_key, state, asked, cells, points)

    def _shifts(self, pictures: torch.Tensor) -> torch.Tensor | None:
        """(B, 2) pixels right and down that pictures are shifted by in training."""
        if not (self.training and self.config.shift):
            return None
        most = self.config.shift
        return torch.randint(-most, most + 1, (len(pictures), 2), device=pictures.device)

    def _lit(self, pictures: torch.Tensor) -> torch.Tensor:
        """(B, 3, h, w) around 0 of (B, h, w, 3) uint8; in training in another light, each its own way."""
        seen = pictures.permute(0, 3, 1, 2).contiguous().float()  # norms are slow where channels are last
        if not (self.training and self.config.brightness):
            return seen / 127.5 - 1
        contrast, light = self.config.brightness * (2 * torch.rand(2, len(seen), 1, 1, 1, device=seen.device) - 1)
        return seen.mul_((1 + contrast) / 127.5).add_(light - 1 - contrast)  # (seen / 127.5 - 1) (1 + contrast) + light


def shifted(pictures: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Pictures (B, h, w, C) shifted by (B, 2) pixels right and down; edges go on outwards."""
    count, height, width, _ = pictures.shape
    device = pictures.device
    rows = (torch.arange(height, device=device) - by[:, 1:]).clamp(0, height - 1)  # (B, h)
    columns = (torch.arange(width, device=device) - by[:, :1]).clamp(0, width - 1)
    picked = torch.arange(count, device=device)[:, None, None]
    return pictures[picked, rows[:, :, None], columns[:, None, :]]
