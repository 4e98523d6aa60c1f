"""The network at the paper's sizes: numbers worked out by hand, on the meta device, where nothing is computed."""

import pytest
import torch

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict import parse

# EfficientNet-B0's table, channels by 1.2 (to eights), repeats by 1.4 (up): expansion, kernel, in, out, repeats
B3 = [
    (1, 3, 40, 24, 2),
    (6, 3, 24, 32, 3),
    (6, 5, 32, 48, 3),
    (6, 3, 48, 96, 5),
    (6, 5, 96, 136, 5),
    (6, 5, 136, 232, 6),
    (6, 3, 232, 384, 2),
]
CHANNELS = sum(out * repeats for *_, out, repeats in B3)  # that FiLM scales and shifts in the blocks


def norm(channels):
    return 2 * channels


def block(expand, kernel, entering, leaving):
    """An MBConv block: expansion, depthwise convolution, squeeze and excite by a quarter of what enters, projection."""
    inner, squeezed = expand * entering, entering // 4
    expansion = entering * inner + norm(inner) if expand > 1 else 0
    depthwise = kernel * kernel * inner + norm(inner)
    excite = inner * squeezed + squeezed + squeezed * inner + inner
    return expansion + depthwise + excite + inner * leaving + norm(leaving)


def efficientnet():
    count = 3 * 40 * 9 + norm(40) + 384 * 1536 + norm(1536)  # stem and top
    for expand, kernel, entering, leaving, repeats in B3:
        count += block(expand, kernel, entering, leaving) + (repeats - 1) * block(expand, kernel, leaving, leaving)
    return count


def parameters(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.fixture(scope="module")
def paper():
    facts = {"action_low": [-0.1] * 6, "action_high": [0.1] * 6}
    with torch.device("meta"):
        return BASELINE.model(RT1Config(), facts).eval()


def test_image_encoder_is_efficientnet_b3_with_film_and_token_learner(paper):
    first, second = paper.encoders
    assert efficientnet() == 10_696_232  # 12 233 232 of B3 without its classifier, 1537 * 1000
    assert CHANNELS == 3608
    assert parameters(first.net) == 10_696_232
    assert len(first.films) == 26
    assert parameters(first.films) == 2 * (384 + 1) * 3608
    assert parameters(first.film) == 2 * (384 + 1) * 512
    assert parameters(first.project) == 1536 * 512
    # norm, 512 to 64, 64 to 8
    assert parameters(first.learner) == 1024 + 512 * 64 + 64 + 64 * 8 + 8 == 34_376
    assert parameters(first) == parameters(second) == 10_696_232 + 2_778_160 + 394_240 + 786_432 + 34_376
    assert not {id(p) for p in first.parameters()} & {id(p) for p in second.parameters()}


def test_transformer(paper):
    attention = 3 * (512 + 1) * 8 * 128 + (8 * 128 + 1) * 512
    layer = attention + (512 + 1) * 512 + 2 * norm(512)
    places = 6 * (2 * 8 + 8) * 512
    assert parameters(paper.transformer) == 8 * layer + (512 + 1) * 512 + places + (512 + 1) * 256 == 19_391_232
    assert parameters(paper) == 2 * 14_689_440 + 19_391_232


def test_parts_have_the_sizes_that_rt1_gives(paper):
    """16 M, 34 k and 19 M, for embeddings of 512 numbers where ours have 384."""
    encoder = paper.encoders[0]
    film = (parameters(encoder.films) + parameters(encoder.film)) * 513 // 385
    assert round((parameters(encoder.net) + parameters(encoder.project) + film) / 1e6) == 16
    assert round(parameters(encoder.learner) / 1e3) == 34
    assert round(parameters(paper.transformer) / 1e6) == 19


def test_shapes(paper):
    with torch.device("meta"):
        features = paper.encoders[0].features(torch.zeros(2, 3, 236, 320), torch.zeros(2, 384))
        tokens = paper.encode(torch.zeros(2, 2, 3, 256, 320, dtype=torch.uint8), torch.zeros(2, 384))
        batch = {
            "rgb": torch.zeros(3, 6, 2, 3, 256, 320, dtype=torch.uint8),
            "language": torch.zeros(3, 384),
            "action": torch.zeros(3, 6, 7),
            "mask": torch.ones(3, 6, dtype=torch.bool),
            "terminate": torch.zeros(3, 6, dtype=torch.bool),
        }
        logits = paper.logits(batch)
        losses = paper(batch)
    assert features.shape == (2, 512, 8, 10)  # 236 x 320 halved five times: 118, 59, 30, 15, 8 rows
    assert tokens.shape == (2, 2 * 8, 512)
    assert logits.shape == (3, 6, 8, 256)
    assert losses["loss"].shape == ()


def test_defaults_are_the_training_configuration_of_the_paper():
    config = RT1Config()
    train = config.train
    assert (config.picture, config.crop_height, config.frames, config.bins) == ((320, 256), 236, 6, 256)
    assert (config.token_width, config.image_tokens, config.width) == (512, 8, 512)
    assert (config.layers, config.heads, config.key_width, config.dropout) == (8, 8, 128, 0.1)
    assert (train.batch_size, train.learning_rate, train.min_learning_rate, train.clip_norm) == (24, 1e-4, 1e-5, 4)
    assert (train.schedule, train.restart_epochs, train.restart_factor) == ("restarts", 20, 2)


def test_changing_a_number_of_the_training_leaves_the_others():
    changed = parse(RT1Config, {"train": {"steps": 300}}, TrainingError, where="rt1").train
    assert changed == RT1Config().train.model_copy(update={"steps": 300})
