"""Image tokens of rt1: crops, FiLM, TokenLearner, EfficientNet and its weights."""

import pytest
import torch
from rt1_sizes import SIZES, settle
from safetensors.torch import save_file

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.image import FiLM, ImageEncoder, StochasticDepth, TokenLearner, make_efficientnet
from robocas_ms3.baselines.rt1.model import crop_rows
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.evaluation.policy import describe_policy


def read_row_numbers(images):
    """Return the row numbers (N, h) of images of `make_striped_images`."""
    return images[:, 0, :, 0]


def make_striped_images(count, height=256, width=4):
    """Return images whose rows have their row number as value, and whose last column is 7."""
    images = torch.arange(height, dtype=torch.uint8)[:, None].repeat(count, 3, 1, width)
    images[..., -1] = 7
    return images


def test_evaluation_uses_the_middle_rows():
    rows = read_row_numbers(crop_rows(make_striped_images(2), 236, random=False))
    assert rows.dtype == torch.float32
    assert rows.tolist() == [list(range(10, 246))] * 2


def test_training_crops_each_image_at_random():
    torch.manual_seed(0)
    seen = crop_rows(make_striped_images(600).view(100, 3, 2, 3, 256, 4), 236, random=True)
    assert seen.shape == (100, 3, 2, 3, 236, 4)
    flat = seen.flatten(0, 2)
    first = read_row_numbers(flat)[:, 0]
    assert set(first.tolist()) == set(range(21))  # 0 to 256 - 236
    assert torch.equal(read_row_numbers(flat), first[:, None] + torch.arange(236))
    assert (flat[..., -1] == 7).all()  # columns stay
    assert torch.equal(flat[:, 0], flat[:, 2])  # colours are cropped together
    torch.manual_seed(0)
    assert torch.equal(crop_rows(make_striped_images(600).view(100, 3, 2, 3, 256, 4), 236, random=True), seen)


def test_film():
    film = FiLM(2)
    features = torch.ones(1, 2, 1, 3)
    with torch.no_grad():
        film.linear.bias[:] = torch.tensor([1.0, 0.0, 0.5, -4.0])  # scales, then shifts
        film.linear.weight[3, 0] = 2.0
    language = torch.zeros(1, 384)
    language[0, 0] = 10
    assert film(features, language)[0, :, 0].tolist() == [[2.5] * 3, [17.0] * 3]


def test_film_layers_start_as_identity_and_use_language_after_training(config):
    torch.manual_seed(0)
    encoder = ImageEncoder(config)
    images, words = torch.randn(2, 3, 40, 64), torch.randn(2, 384)
    with torch.no_grad():
        settle(encoder, images, words)
        plain = encoder.compute_features(images, torch.zeros(2, 384))
        assert torch.equal(encoder.compute_features(images, words), plain)
        # equal to transformers' EfficientNet with the convolution after it
        wanted = encoder.project(encoder.net(images).last_hidden_state)
        assert torch.allclose(plain, wanted, atol=1e-6)
        for number in (0, len(encoder.films) - 1):
            encoder.films[number].linear.weight.normal_(0, 0.1)
            spoken = encoder.compute_features(images, words)
            assert not torch.allclose(spoken, plain, rtol=1e-3)
            encoder.films[number].linear.weight.zero_()
        encoder.film.linear.weight.normal_(0, 0.1)
        assert not torch.allclose(encoder.compute_features(images, words), plain, rtol=1e-3)


def test_token_learner_weights_positions():
    learner = TokenLearner(2, 3, 2)
    with torch.no_grad():
        learner.score.weight.zero_()
        learner.score.bias.zero_()
    features = torch.tensor([[[1.0, 5.0], [3.0, -1.0], [2.0, 2.0]]])
    assert torch.allclose(learner(features), torch.tensor([[[2.0, 2.0], [2.0, 2.0]]]))  # the mean, for each token
    with torch.no_grad():
        # normalised, the positions are about (-1, 1), (1, -1) and (0, 0); the first hidden unit is gelu(100 first)
        learner.hidden.weight.zero_()
        learner.hidden.bias.zero_()
        learner.hidden.weight[0, 0] = 100.0
        learner.score.weight[1, 0] = 1.0
    found = learner(features)
    assert torch.allclose(found[0, 0], torch.tensor([2.0, 2.0]))
    assert torch.allclose(found[0, 1], torch.tensor([3.0, -1.0]), atol=1e-5)  # the second position alone


def test_stochastic_depth_skips_whole_images():
    torch.manual_seed(0)
    skip, branch = StochasticDepth(0.25), torch.randn(400, 2, 2, 2)
    kept = skip(branch)
    zero = (kept == 0).flatten(1)
    assert torch.equal(zero.all(1), zero.any(1))
    assert 60 <= int(zero.all(1).sum()) <= 140  # 100 of 400, +- 4.6 deviations
    assert torch.allclose(kept[~zero.all(1)], branch[~zero.all(1)] / 0.75)
    assert torch.equal(skip.eval()(branch), branch)


@pytest.fixture
def weights(config):
    """Return weights of another network of this size, with transformers' names and a classifier."""
    torch.manual_seed(5)
    made = {f"efficientnet.{name}": value + 1 for name, value in make_efficientnet(config).state_dict().items()}
    return {**made, "classifier.weight": torch.zeros(10, 320)}


@pytest.mark.parametrize(("prefix", "kind"), [("efficientnet.", "safetensors"), ("", "bin")])
def test_both_encoders_start_from_the_weights_of_a_file(weights, prefix, kind, facts, tmp_path, batch):
    path = tmp_path / f"b3.{kind}"
    named = {name.replace("efficientnet.", prefix): value for name, value in weights.items()}
    save_file(named, path) if kind == "safetensors" else torch.save(named, path)
    config = RT1Config(**SIZES, image_weights=path)
    model = BASELINE.model(config, facts)
    for encoder in model.encoders:
        for name, value in encoder.net.state_dict().items():
            assert torch.equal(value, weights[f"efficientnet.{name}"]), name
    assert describe_policy(BASELINE.policy(config, facts, model))["image_weights"] == path.name
    model.train()(batch)["loss"].backward()


def test_images_are_normalised_as_for_the_weights(tmp_path, config, facts):
    assert RT1Config().used_image_std == (0.229, 0.224, 0.225)
    assert RT1Config(image_weights=tmp_path).used_image_std == pytest.approx(
        [0.229**0.5, 0.224**0.5, 0.225**0.5], abs=1e-5
    )
    assert RT1Config(image_weights=tmp_path, image_std=(0.5, 0.5, 0.5)).used_image_std == (0.5, 0.5, 0.5)
    policy = BASELINE.policy(config, facts, BASELINE.model(config, facts))
    assert describe_policy(policy)["image_weights"] == "from scratch"


def test_a_trained_network_does_not_need_the_file(weights, facts, tmp_path, batch):
    path = tmp_path / "b3.safetensors"
    save_file(weights, path)
    config = RT1Config(**SIZES, image_weights=path)
    trained = BASELINE.model(config, facts)
    path.unlink()
    model = BASELINE.model(config, facts)
    assert torch.isfinite(model.eval()(batch)["loss"])
    with pytest.raises(TrainingError, match="image_weights .*b3.safetensors"):
        model.train()(batch)
    model.load_state_dict(trained.state_dict())
    assert describe_policy(BASELINE.policy(config, facts, model))["image_weights"] == "b3.safetensors"
    model.train()(batch)  # an interrupted training continues without the file


WEIGHT = "efficientnet.encoder.blocks.2.depthwise_conv.depthwise_conv.weight"


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda weights: weights.pop(WEIGHT), "1 of "),
        (lambda weights: weights.update({WEIGHT: torch.zeros(3)}), "1 of "),
        (lambda weights: (weights.clear(), weights.update({"features.0.weight": torch.zeros(3)})), " of "),
    ],
)
def test_weights_of_another_network(change, found, weights, facts, tmp_path):
    path = tmp_path / "b3.safetensors"
    change(weights)
    save_file(weights, path)
    with pytest.raises(TrainingError) as caught:
        BASELINE.model(RT1Config(**SIZES, image_weights=path), facts)
    assert caught.value.where == path and found in caught.value.found and "image_width" in caught.value.fix


@pytest.mark.parametrize("name", ["b3.safetensors", "b3.bin", "list.bin"])
def test_files_without_weights(name, facts, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"not weights at all")
    if name == "list.bin":
        torch.save([1, 2], path)
    with pytest.raises(TrainingError) as caught:
        BASELINE.model(RT1Config(**SIZES, image_weights=path), facts)
    assert caught.value.where == path
    assert "\n" not in str(caught.value)
