"""Image tokens, as in RT-1 (Brohan et al. 2022): EfficientNet with FiLM by language, then TokenLearner."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.core.errors import TrainingError, require_extra
from robocas_ms3.scenes.language.embed import DIMENSIONS

_SQUARE_PADDED = (5, 18)
"""EfficientNet-B3's blocks that halve an odd number of rows: of 300, its own size, 75 and 19; of 236 rows 59 and 15."""
_EXPECTED = "EfficientNet's weights by transformers' names"


class FiLM(nn.Module):
    """Language scales and shifts the channels of feature maps (Perez et al. 2018); at first it changes nothing."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.told = nn.Linear(DIMENSIONS, 2 * channels)
        nn.init.zeros_(self.told.weight)
        nn.init.zeros_(self.told.bias)

    def forward(self, features: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return (N, C, h, w) for (N, C, h, w) and embeddings (N, 384)."""
        scale, shift = self.told(language)[:, :, None, None].chunk(2, dim=1)
        return features * (1 + scale) + shift


class TokenLearner(nn.Module):
    """A few tokens, each a mean of an image's features, weighted by these (Ryoo et al. 2021, V1.1)."""

    def __init__(self, width: int, bottleneck: int, tokens: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.hidden, self.weigh = nn.Linear(width, bottleneck), nn.Linear(bottleneck, tokens)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return (N, tokens, C) for features (N, P, C)."""
        logits = self.weigh(F.gelu(self.hidden(self.norm(features)), approximate="tanh"))
        return logits.softmax(dim=1).transpose(1, 2) @ features


class StochasticDepth(nn.Module):
    """Skips a block for whole images (Huang et al. 2016); transformers drops single numbers."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, branch: torch.Tensor) -> torch.Tensor:
        """Return (N, C, h, w) for the same."""
        if not self.training or self.share == 0:
            return branch
        kept = torch.rand(len(branch), 1, 1, 1, device=branch.device) >= self.share
        return branch * kept / (1 - self.share)


class ImageEncoder(nn.Module):
    """Tokens of a camera's images.

    FiLM follows each of EfficientNet's blocks (26 in B3) and, as in RT-1's own code, the convolution after it.
    """

    def __init__(self, config: RT1Config) -> None:
        super().__init__()
        self.net = efficientnet(config)
        blocks = self.net.encoder.blocks
        self.films = nn.ModuleList([FiLM(block.projection.project_conv.out_channels) for block in blocks])
        features = self.net.encoder.top_conv.out_channels
        self.project = nn.Conv2d(features, config.token_width, 1, bias=False)
        self.film = FiLM(config.token_width)
        self.learner = TokenLearner(config.token_width, config.token_bottleneck, config.image_tokens)

    def features(self, images: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return (N, token_width, h / 32, w / 32) for normalised images (N, 3, h, w) and embeddings (N, 384)."""
        hidden = self.net.embeddings(images)
        encoder = self.net.encoder
        for block, film in zip(encoder.blocks, self.films, strict=True):
            hidden = film(block(hidden), language)
        hidden = encoder.top_activation(encoder.top_bn(encoder.top_conv(hidden)))
        return self.film(self.project(hidden), language)

    def forward(self, images: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return (N, image_tokens, token_width) for the same."""
        return self.learner(self.features(images, language).flatten(2).transpose(1, 2))

    def load_efficientnet(self, path: Path) -> None:
        """Load EfficientNet's weights from a file, which may hold more, such as a classifier's."""
        tensors = {name.removeprefix("efficientnet."): value for name, value in _read_weights(path).items()}
        own = self.net.state_dict()
        counters = {name: value for name, value in own.items() if name.endswith("num_batches_tracked")}
        tensors = {**counters, **tensors}
        wrong = [name for name, value in own.items() if getattr(tensors.get(name), "shape", None) != value.shape]
        if wrong:
            raise TrainingError(
                "not the weights of this network",
                where=path,
                expected=f"{_EXPECTED}, such as {wrong[0]} {tuple(own[wrong[0]].shape)}",
                found=f"{len(wrong)} of {len(own)} missing or of another shape",
                fix="image_width and image_depth say which EfficientNet: 1.2 and 1.4 are B3.",
            )
        self.net.load_state_dict({name: tensors[name] for name in own})


def _read_weights(path: Path) -> dict[str, Any]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        if path.suffix == ".safetensors":
            found: Any = load_file(path)
        else:
            found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, SafetensorError, pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise TrainingError("can't be read", where=path, expected=_EXPECTED, found=reason) from error
    if not isinstance(found, dict):
        raise TrainingError("no weights", where=path, expected=_EXPECTED, found=type(found).__name__)
    return found


def efficientnet(config: RT1Config) -> Any:
    """Return EfficientNetModel of transformers with random weights: B3 by default, with 10.7 M parameters."""
    require_extra("train", "rt1", "transformers")
    from transformers import EfficientNetConfig, EfficientNetModel

    net = EfficientNetModel(
        EfficientNetConfig(
            width_coefficient=config.image_width,
            depth_coefficient=config.image_depth,
            hidden_dim=_round_channels(1280 * config.image_width),
            depthwise_padding=list(_SQUARE_PADDED),
            drop_connect_rate=config.drop_connect,
        )
    )
    blocks: Any = net.encoder.blocks
    for block in blocks:
        block.projection.dropout = StochasticDepth(block.projection.dropout.p)
    for module in net.modules():
        # transformers begins with all weights near 0, even those of norms, and lets a batch be 99 % of running means
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = config.norm_momentum
            module.reset_parameters()
        elif isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out")
    return net


def _round_channels(channels: float) -> int:
    """Round channels as EfficientNet does: to eights, down by a tenth at most."""
    rounded = max(8, int(channels + 4) // 8 * 8)
    return rounded + 8 if rounded < 0.9 * channels else rounded
