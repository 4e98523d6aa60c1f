"""Policy of rt1: history of frames per env, termination, and training on five episodes."""

import numpy as np
import pytest
import torch
from rt1_sizes import SIZES
from synthetic_observations import observe, start
from training_runs import fit

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.model import most_probable_tokens

CAMERAS = ("base_camera", "gripper_camera")


def start_episodes(*envs):
    return [start(env) for env in envs]


def observations(envs, images, words):
    """Return observations of envs with images (E, 2, 48, 64, 3) and embeddings (E, 384)."""
    return observe(envs, embeddings=words, images={name: images[:, view] for view, name in enumerate(CAMERAS)})


@pytest.fixture
def policy(config, facts, model):
    """Return a policy that never terminates an episode."""
    model.transformer.head.bias.data[1] = -1e3
    return BASELINE.policy(config, facts, model)


@pytest.fixture
def seen():
    """Return images of three envs over nine steps, and their embeddings."""
    rng = np.random.default_rng(0)
    words = rng.normal(size=(3, 384)).astype(np.float32)
    images = rng.integers(0, 256, (9, 3, 2, 48, 64, 3), dtype=np.uint8)
    return images, words / np.linalg.norm(words, axis=1, keepdims=True)


def test_images_are_requested_in_the_size_of_the_dataset(config, facts, model):
    """The policy scales images as the training does; images rendered at 64 x 48 have another field of view."""
    stored = {**facts, "cameras": {"base_camera": [96, 64], "gripper_camera": [128, 96]}}
    policy = BASELINE.policy(config, stored, model)
    assert (policy.spec.convention, policy.spec.reference, policy.spec.rate_hz) == ("robocas", "tcp", 5.0)
    assert policy.spec.cameras == {"base_camera": (96, 64), "gripper_camera": (128, 96)}
    policy.reset(start_episodes(0))
    images = {"base_camera": np.zeros((1, 64, 96, 3), np.uint8), "gripper_camera": np.zeros((1, 96, 128, 3), np.uint8)}
    assert policy.act(observe(embeddings=np.ones((1, 384), np.float32), images=images)).shape == (1, 7)


def expected_action(model, images, words, step, first=0):
    """Return the action after the last six frames, encoded together like a sample of a dataset."""
    frames = [max(number, first) for number in range(step - 5, step + 1)]
    rgb = torch.from_numpy(images[frames]).permute(0, 1, 4, 2, 3)  # (6, 2, 3, 48, 64)
    logits = model.logits({"rgb": rgb[None], "language": torch.from_numpy(words)[None]})
    return model.bins.decode(most_probable_tokens(logits[0, -1])[:7]).numpy()


def test_stored_tokens_give_the_actions_of_encoded_frames(policy, model, seen):
    """Three envs; one starts a second episode. Each step encodes one frame per env, in any order of envs."""
    images, words = seen
    policy.reset(start_episodes(0, 1, 2))
    first, counts, encode = {0: 0, 1: 0, 2: 0}, [], model.encode
    for step in range(9):
        if step == 4:
            policy.reset(start_episodes(1))
            first[1] = 4
        envs = [2, 0, 1] if step % 2 else [0, 1, 2]
        with torch.inference_mode():
            wanted = [expected_action(model, images[:, env], words[env], step, first[env]) for env in envs]
        model.encode = lambda images, language: counts.append(len(images)) or encode(images, language)
        acted = policy.act(observations(envs, images[step, envs], words[envs]))
        model.encode = encode
        assert np.array_equal(acted, np.stack(wanted)), step
    assert len({tuple(row) for row in wanted}) == 3
    assert counts == [1] * 27


def test_no_motion_after_termination(policy, model, seen):
    """The terminal action is executed; other envs continue, and a new episode moves again."""
    images, words = seen
    moving, gripper = [0.03] * 7, [0.03] * 6 + [0.9]
    predicted = [(moving, False), (gripper, False)]  # of 4 and 7
    predicted += [(moving, False), (gripper, True), (moving, False), (moving, True), (gripper, False)]

    def act(tokens):
        action, is_last = predicted.pop(0)
        return torch.tensor([action]), torch.tensor([is_last])

    model.act = act
    policy.reset(start_episodes(4, 7))
    shown = observations([4, 7], images[0, :2], words[:2])
    nothing = [0.0] * 6 + [0.9]
    assert np.allclose(policy.act(shown), [moving, gripper])
    assert np.allclose(policy.act(shown), [moving, gripper])  # the second env terminates
    assert np.allclose(policy.act(shown), [moving, nothing])
    assert policy.requests_images(np.array([4, 7])).tolist() == [True, False]
    policy.reset(start_episodes(7))
    assert policy.requests_images(np.array([4, 7])).tolist() == [True, True]
    assert np.allclose(policy.act(shown), [moving, gripper])
    assert predicted == []
    assert np.allclose(
        policy.act(observations([4], images[0, :1], words[:1])), [[0.0] * 6 + [0.03]]
    )  # without a prediction


def test_samples_are_learned(folder):
    """The loss of one batch falls from the chance level."""
    sizes = {"image_size": (48, 36), "crop_height": 32, "frames": 2, "image_width": 0.1, "token_width": 64, "width": 64}
    config = RT1Config(**{**SIZES, **sizes, "dropout": 0.0, "drop_connect": 0.0})
    samples = BASELINE.data(config, folder, "val", lambda done, total: None)  # one episode
    _, losses = fit(BASELINE, config, samples, 25)
    assert losses[-1] < 0.4 * losses[0]
