"""Image tokens as in RT-1 (Brohan et al. 2022): EfficientNet with FiLM by language, then TokenLearner."""

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
"""EfficientNet-B3's blocks that halve an odd number of rows: 75 and 19 of 300 rows; 59 and 15 of 236 rows."""
_EXPECTED = "weights of transformers' EfficientNetModel"
_FIX = "Set image_weights to model.safetensors of google/efficientnet-b3."


class FiLM(nn.Module):
    """FiLM layer (Perez et al. 2018): an embedding scales and shifts the channels of image features.

    The initial scale is 1 and the initial shift is 0, so a new layer does not change its input.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(DIMENSIONS, 2 * channels)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, features: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return the modulated features (N, C, h, w).

        features: (N, C, h, w). language: (N, 384) instruction embeddings.
        """
        scale, shift = self.linear(language)[:, :, None, None].chunk(2, dim=1)
        return features * (1 + scale) + shift


class TokenLearner(nn.Module):
    """TokenLearner V1.1 (Ryoo et al. 2021): tokens are attention-weighted means of image features."""

    def __init__(self, width: int, bottleneck: int, tokens: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.hidden, self.score = nn.Linear(width, bottleneck), nn.Linear(bottleneck, tokens)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return tokens (N, tokens, C), from the features (N, P, C) of P image positions."""
        logits = self.score(F.gelu(self.hidden(self.norm(features)), approximate="tanh"))
        return logits.softmax(dim=1).transpose(1, 2) @ features


class StochasticDepth(nn.Module):
    """Stochastic depth (Huang et al. 2016): in training, drop the residual branch of some images.

    It replaces the plain dropout in transformers' EfficientNet. ``rate`` is the probability that a branch is dropped.
    """

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate

    def forward(self, branch: torch.Tensor) -> torch.Tensor:
        """Return the features (N, C, h, w) of a residual branch, 0 for dropped images."""
        if not self.training or self.rate == 0:
            return branch
        kept = torch.rand(len(branch), 1, 1, 1, device=branch.device) >= self.rate
        return branch * kept / (1 - self.rate)


class ImageEncoder(nn.Module):
    """Image encoder of RT-1: EfficientNet with FiLM layers and TokenLearner, for the images of one camera.

    A FiLM layer follows each block of EfficientNet (26 blocks in B3). As in RT-1's code, another FiLM layer follows the
    convolution after the blocks.
    """

    def __init__(self, config: RT1Config) -> None:
        super().__init__()
        self.net = make_efficientnet(config)
        blocks = self.net.encoder.blocks
        self.films = nn.ModuleList([FiLM(block.projection.project_conv.out_channels) for block in blocks])
        features = self.net.encoder.top_conv.out_channels
        self.project = nn.Conv2d(features, config.token_width, 1, bias=False)
        self.film = FiLM(config.token_width)
        self.learner = TokenLearner(config.token_width, config.token_bottleneck, config.image_tokens)

    def compute_features(self, images: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return features (N, token_width, h / 32, w / 32) of normalised images (N, 3, h, w).

        language: (N, 384) instruction embeddings.
        """
        hidden = self.net.embeddings(images)
        encoder = self.net.encoder
        for block, film in zip(encoder.blocks, self.films, strict=True):
            hidden = film(block(hidden), language)
        hidden = encoder.top_activation(encoder.top_bn(encoder.top_conv(hidden)))
        return self.film(self.project(hidden), language)

    def forward(self, images: torch.Tensor, language: torch.Tensor) -> torch.Tensor:
        """Return tokens (N, image_tokens, token_width) of normalised images (N, 3, h, w).

        language: (N, 384) instruction embeddings.
        """
        return self.learner(self.compute_features(images, language).flatten(2).transpose(1, 2))

    def load_efficientnet_weights(self, path: Path) -> None:
        """Load the weights of EfficientNet from a file.

        Other tensors in the file, such as those of a classifier, are ignored.

        Raises:
            TrainingError: the file is unreadable, or the weights have other names or shapes than the network.
        """
        tensors = {name.removeprefix("efficientnet."): value for name, value in _read_weights(path).items()}
        own = self.net.state_dict()
        counters = {name: value for name, value in own.items() if name.endswith("num_batches_tracked")}
        tensors = {**counters, **tensors}
        wrong = [name for name, value in own.items() if getattr(tensors.get(name), "shape", None) != value.shape]
        if wrong:
            raise TrainingError(
                "the weights do not fit the EfficientNet of rt1",
                where=path,
                expected=f"{_EXPECTED}, such as {wrong[0]} {tuple(own[wrong[0]].shape)}",
                found=f"{len(wrong)} of {len(own)} tensors missing or of another shape",
                fix="Set image_width and image_depth to those of the weights: 1.2 and 1.4 for B3.",
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
        raise TrainingError(
            "unreadable file of image_weights", where=path, expected=_EXPECTED, found=reason, fix=_FIX
        ) from error
    if not isinstance(found, dict):
        found = type(found).__name__
        raise TrainingError("invalid file of image_weights", where=path, expected=_EXPECTED, found=found, fix=_FIX)
    return found


def make_efficientnet(config: RT1Config) -> Any:
    """Make an EfficientNetModel of transformers with random weights.

    The default configuration is EfficientNet-B3, with 10.7 M parameters.
    """
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
        # transformers initialises all weights near 0, also those of norms, and updates running means by 99 % per batch
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = config.norm_momentum
            module.reset_parameters()
        elif isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out")
    return net


def _round_channels(channels: float) -> int:
    """Round a number of channels to a multiple of 8, and down by at most 10 %, as EfficientNet does."""
    rounded = max(8, int(channels + 4) // 8 * 8)
    return rounded + 8 if rounded < 0.9 * channels else rounded
