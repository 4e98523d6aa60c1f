"""What rt1 does: its memory of frames, an env at a time, and the end."""

import numpy as np
import pytest
import torch

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.model import chosen
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec

CAMERAS = ("base_camera", "gripper_camera")


def begin(*envs):
    return [EpisodeSpec(env, 0, "pick", "", "", "builtin", env, "grasp it") for env in envs]


def observations(envs, shots, words):
    """Of envs, whose pictures are (E, 2, 48, 64, 3) and words (E, 384)."""
    count = len(envs)
    nothing = np.zeros((count, 12), np.float32)
    return Observations(
        envs=np.array(envs),
        instructions=[""] * count,
        embeddings=words,
        images={name: shots[:, view] for view, name in enumerate(CAMERAS)},
        depths={},
        robot={"qpos": nothing, "tcp_in_base": nothing[:, :7], "gripper_width": nothing[:, :1]},
        state=None,
    )


@pytest.fixture
def policy(config, facts, model):
    """That tells no end."""
    model.transformer.leave.bias.data[1] = -1e3
    return BASELINE.policy(config, facts, model)


@pytest.fixture
def seen():
    """Pictures of three envs over nine steps, and what they were told."""
    rng = np.random.default_rng(0)
    words = rng.normal(size=(3, 384)).astype(np.float32)
    shots = rng.integers(0, 256, (9, 3, 2, 48, 64, 3), dtype=np.uint8)
    return shots, words / np.linalg.norm(words, axis=1, keepdims=True)


def test_what_it_wants(policy):
    assert policy.spec == PolicySpec(
        convention="robocas",
        reference="tcp",
        rate_hz=5.0,
        cameras={"base_camera": (64, 48), "gripper_camera": (64, 48)},
        language="embedding",
    )


def test_it_wants_pictures_as_the_dataset_stores_them(config, facts, model):
    """And scales them: rendered at 64 x 48 they would show another field of view."""
    stored = {**facts, "cameras": {"base_camera": [96, 64], "gripper_camera": [128, 96]}}
    policy = BASELINE.policy(config, stored, model)
    assert policy.spec.cameras == {"base_camera": (96, 64), "gripper_camera": (128, 96)}
    policy.reset(begin(0))
    shown = observations([0], np.zeros((1, 2, 48, 64, 3), np.uint8), np.ones((1, 384), np.float32))
    shown.images.update(
        base_camera=np.zeros((1, 64, 96, 3), np.uint8), gripper_camera=np.zeros((1, 96, 128, 3), np.uint8)
    )
    assert policy.act(shown).shape == (1, 7)


def wanted(model, shots, words, step, first=0):
    """The action after the last six frames, all encoded anew, as a sample of a dataset has them."""
    frames = [max(number, first) for number in range(step - 5, step + 1)]
    pictures = torch.from_numpy(shots[frames]).permute(0, 1, 4, 2, 3)  # (6, 2, 3, 48, 64)
    logits = model.logits({"rgb": pictures[None], "language": torch.from_numpy(words)[None]})
    said = chosen(logits[0, -1])
    return model.bins.decode(said[:7]).numpy()


def test_kept_tokens_act_as_frames_encoded_anew(policy, model, seen):
    """Three envs, one of which begins anew meanwhile, and is asked in another order."""
    shots, words = seen
    policy.reset(begin(0, 1, 2))
    first = {0: 0, 1: 0, 2: 0}
    for step in range(9):
        if step == 4:
            policy.reset(begin(1))
            first[1] = 4
        envs = [2, 0, 1] if step % 2 else [0, 1, 2]
        with torch.inference_mode():
            expected = [wanted(model, shots[:, env], words[env], step, first[env]) for env in envs]
        acted = policy.act(observations(envs, shots[step, envs], words[envs]))
        assert acted.shape == (3, 7)
        assert np.array_equal(acted, np.stack(expected)), step
    assert len({tuple(row) for row in expected}) == 3


def test_tokens_that_are_kept_are_those_of_their_frames(policy, model, seen):
    shots, words = seen
    policy.reset(begin(0))
    given = []
    act = model.act
    model.act = lambda tokens: given.append(tokens) or act(tokens)
    for step in range(8):
        policy.act(observations([0], shots[step, :1], words[:1]))
    pictures = torch.from_numpy(shots[2:8, 0]).permute(0, 1, 4, 2, 3)
    with torch.inference_mode():
        tokens = model.encode(pictures, torch.from_numpy(words[:1]).expand(6, -1))
    assert given[7].shape == (1, 6, 8, 32)
    assert torch.allclose(given[7][0], tokens, atol=1e-5)
    assert torch.equal(given[0][0, 0], given[0][0, 5])  # the first one, repeated


def test_a_step_encodes_one_frame_an_env(policy, model, seen):
    shots, words = seen
    counts = []
    encode = model.encode
    model.encode = lambda pictures, language: counts.append(len(pictures)) or encode(pictures, language)
    policy.reset(begin(0, 1, 2))
    for step in range(3):
        policy.act(observations([0, 1, 2], shots[step], words))
    assert counts == [1] * 9


def test_after_the_end_an_env_holds_still(policy, model, seen):
    """The action beside the end is still done; others go on, and a new episode wakes."""
    shots, words = seen
    moving, gripper = [0.03] * 7, [0.03] * 6 + [0.9]
    said = [(moving, False), (gripper, False)]  # of 4 and 7
    said += [(moving, False), (gripper, True), (moving, False), (moving, True), (gripper, False)]

    def act(tokens):
        action, over = said.pop(0)
        return torch.tensor([action]), torch.tensor([over])

    model.act = act
    policy.reset(begin(4, 7))
    shown = observations([4, 7], shots[0, :2], words[:2])
    still = [0.0] * 6 + [0.9]
    assert np.allclose(policy.act(shown), [moving, gripper])
    assert np.allclose(policy.act(shown), [moving, gripper])  # here the second tells its end
    assert np.allclose(policy.act(shown), [moving, still])
    policy.reset(begin(7))
    assert np.allclose(policy.act(shown), [moving, gripper])
    assert said == []
    assert np.allclose(policy.act(observations([4], shots[0, :1], words[:1])), [[0.0] * 6 + [0.03]])  # asks nobody
