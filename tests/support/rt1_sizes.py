"""Small sizes of rt1, and normalization layers with statistics of images."""

from torch import nn

SIZES = {
    "image_size": (64, 48),
    "crop_height": 40,
    "image_width": 0.25,
    "image_depth": 0.1,
    "norm_momentum": 0.1,
    "token_width": 32,
    "image_tokens": 4,
    "token_bottleneck": 16,
    "width": 32,
    "layers": 2,
    "heads": 2,
    "key_width": 16,
}
"""Seven blocks of EfficientNet, 8 to 80 channels wide."""


def settle(network, *seen):
    """Set the statistics of the normalization layers of a network from its inputs; initial ones suppress the signal."""
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    before = [module.momentum for module in norms]
    for module in norms:
        module.momentum = 1.0
    network.train()(*seen)
    for module, momentum in zip(norms, before, strict=True):
        module.momentum = momentum
    network.eval()
