"""Action chunks of poses: encoding, loss and policy."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_observations import observe, start

from robocas_ms3.baselines.chunks import (
    ChunkPolicy,
    Normalizer,
    compute_chunk_losses,
    compute_normalizer_statistics,
    decode_chunk,
    encode_chunks,
    encode_next_key_poses,
)
from robocas_ms3.evaluation.policy import PolicySpec


def test_encoding_of_a_chunk():
    poses = np.tile(np.eye(4), (3, 1, 1))
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # 90 degrees about z
    poses[0, :3, :3] = quarter
    poses[1, :3, 3] = poses[2, :3, 3] = 0, 0.5, 0.25
    rows = encode_chunks(poses, [True, True, False], 3)
    # y of the base is x of a TCP rotated by 90 degrees; its x axis then points along y of the base
    assert np.allclose(rows[0, 0], [0.5, 0, 0.25, 0, -1, 0, 1, 0, 0, 1])
    assert np.allclose(rows[0, 1, 9], 0)
    assert np.allclose(rows[0, 2], rows[0, 1])  # after the end the last pose repeats
    assert np.allclose(rows[2], [0, 0, 0, 1, 0, 0, 0, 1, 0, 0])


def test_labels_lead_to_the_intended_poses():
    poses, intended = (np.tile(np.eye(4), (3, 1, 1)) for _ in range(2))
    intended[:, 0, 3] = [0, 1, 2]
    poses[:, 0, 3] = [0, 1.25, 1.5]  # deviations 0.25 and -0.5
    chunks = encode_chunks(poses, [1, 1, 1], 2, intended)
    assert chunks[:2, :, 0].tolist() == [[1, 2], [0.75, 0.75]]
    assert encode_next_key_poses(poses, [1, 1, 1], intended)[:, 0].tolist() == [2, 0.75, 0.5]


@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 5))
def test_decoding_inverts_encoding(seed, length, steps):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (length, 1, 1))
    poses[:, :3, :3] = Rotation.random(length, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(length, 3))
    opened = rng.random(length) > 0.5
    found, commands = decode_chunk(encode_chunks(poses, opened, steps), poses[:, None])
    for t in range(length):
        for k in range(steps):
            at = min(t + k + 1, length - 1)
            assert np.allclose(found[t, k], poses[at], atol=1e-5)
            assert commands[t, k] == opened[at]


@given(st.integers(0, 10_000))
def test_any_prediction_becomes_a_rotation(seed):
    poses, _ = decode_chunk(np.random.default_rng(seed).normal(size=(4, 10)), np.eye(4))
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.eye(3), atol=1e-6)
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)


def test_key_poses_are_at_the_next_gripper_command():
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, 0, 3] = [0, 1, 2, 3, 4, 5, 6]
    # commands: close after step 2, open after step 4; then the end of the episode
    keys = encode_next_key_poses(poses, [1, 1, 1, 0, 0, 1, 1])
    assert keys[:, 0].tolist() == [2, 1, 0, 1, 0, 1, 0]


def test_normalizer_and_inverse():
    motions = np.array([[[0.0] * 9], [[1.0] * 9]])  # two samples of one step: mean 0.5, deviation 0.5
    scale = Normalizer(**compute_normalizer_statistics(motions))
    assert torch.allclose(scale(torch.ones(1, 9)), torch.ones(1, 9))
    assert torch.allclose(scale.inverse(scale(torch.full((1, 9), 0.3))), torch.full((1, 9), 0.3))
    assert min(compute_normalizer_statistics(np.zeros((2, 1, 9)))["deviation"][0]) > 0


def losses(near_distance):
    """Return the losses of two samples of one step: label at 0.1 m with an error of 0.3 m; label at 0.3 m, no error."""
    weights, one = (
        SimpleNamespace(near_distance=near_distance, gripper_weight=0.5, keys_weight=2.0),
        Normalizer([0.0] * 9, [1.0] * 9),
    )
    model = SimpleNamespace(config=weights, chunk_scale=one, key_scale=one)
    chunk, key = torch.zeros(2, 1, 10), torch.zeros(2, 9)
    chunk[0, 0, 0], chunk[1, 0, 0], key[:, 1] = 0.1, 0.3, 0.04
    found = chunk.clone()
    found[0, 0, 0] += 0.3
    return compute_chunk_losses(model, {"chunk": chunk, "key": key}, found, key + 0.003)


def test_losses():
    found = losses(near_distance=0.0)
    assert found["motion"].item() == pytest.approx(0.3 / 9 / 2)
    assert found["gripper"].item() == pytest.approx(0.693147)  # log(2): probability 0.5
    assert found["keys"].item() == pytest.approx(0.003)
    assert found["loss"].item() == pytest.approx(0.3 / 18 + 0.5 * 0.693147 + 2 * 0.003)
    assert found["first_mm"].item() == found["last_mm"].item() == pytest.approx(150)
    assert found["near_mm"].tolist() == [2 * found["key_mm"].item(), 2.0]  # of both samples
    assert found["key_mm"].item() == pytest.approx(3 * 3**0.5)
    weighted = losses(near_distance=0.1)["motion"].item()
    assert weighted == pytest.approx(0.3 / 9 * 2 / 3)  # weights 1/2 and 1/4 with 0.1 m


def row(x=0.0, opened=1.0):
    return [x, 0, 0, 1, 0, 0, 0, 1, 0, opened]


HERE = [0.5, 0, 0.3, 1, 0, 0, 0]


def policy(*chunks, n_action_steps=1, temporal_ensemble_coeff=0.0, reopen=0.0):
    """Return a policy for envs 0 and 1 that predicts the given chunks in turn."""
    rest = iter(chunks)
    made = ChunkPolicy(
        PolicySpec(),
        lambda observations, _: np.array(next(rest), float),
        n_action_steps,
        temporal_ensemble_coeff,
        reopen,
    )
    made.reset([start(0), start(1)])
    return made


def act(policy, *tcps, envs=(0,), width=0.0):
    tcps = np.float32(tcps or [HERE] * len(envs))
    widths = np.full((len(envs), 1), width, np.float32)
    return policy.act(observe(envs, tcp_in_base=tcps, gripper_width=widths))


def test_first_chunk_is_executed():
    acting = policy([row(0.1), row(0.2)])
    assert act(acting) == pytest.approx(np.array([[0.1, 0, 0, 0, 0, 0, 1]]), abs=1e-6)


def test_older_predictions_are_for_the_same_step_and_frame():
    """The TCP does not move. An older chunk predicts 0.2 for this step, the new chunk 0.4; the action is their mean."""
    acting = policy([row(0.1), row(0.2)], [row(0.4), row(0.5)])
    act(acting)
    assert act(acting)[0, 0] == pytest.approx(0.3)
    acting = policy([row(0.1), row(0.2)], [row(0.1), row(0.2)])
    act(acting)
    late = [0.56, *HERE[1:]]  # 0.04 short of its target: the older prediction is 0.7, the newer 0.66
    assert act(acting, late)[0, 0] == pytest.approx((0.7 + 0.66) / 2 - 0.56)


def test_newer_predictions_weigh_more():
    acting = policy([row(), row(0.0, 0.0)], [row(0.4, 1.0), row()], temporal_ensemble_coeff=np.log(3))  # 3 to 1
    act(acting)
    action = act(acting)[0]
    assert action[0] == pytest.approx(0.3)
    assert action[6] == 1.0


def test_n_action_steps_are_executed_before_the_next_prediction():
    """Two of three steps; then the mean of the third row and the first row of the next chunk."""
    acting = policy([row(0.1), row(0.2), row(0.3)], [row(0.5), row(), row()], n_action_steps=2)
    asked, actions = [], []
    for _ in range(3):
        asked += acting.requests_images(np.array([0])).tolist()
        actions.append(act(acting)[0, 0])
    assert actions == pytest.approx([0.1, 0.2, 0.4])
    assert asked == [True, False, True]


def test_each_env_has_its_own_chunks():
    """A reset drops the chunks of one env."""
    acting = policy(*[[row(0.2), row(0.2)]] * 2, *[[row(0.4), row()]] * 2)
    act(acting, envs=(0, 1))
    acting.reset([start(1)])
    assert act(acting, envs=(0, 1))[:, 0].tolist() == pytest.approx([0.3, 0.4])
    acting = policy([row(0.1), row(0.2)], [row(0.3), row(0.4)], [row(0.5), row(0.6)], n_action_steps=2)
    assert act(acting, envs=(0, 1))[:, 0].tolist() == pytest.approx([0.1, 0.3])
    acting.reset([start(1)])
    assert act(acting, envs=(0, 1))[:, 0].tolist() == pytest.approx([0.2, 0.5])


CLOSED = [row(0.0, 0.0), row(0.0, 0.0)]


@pytest.mark.parametrize(
    ("reopen", "width", "moved", "opened"),
    [
        (0.02, 0.001, 0.015, 1.0),  # closed on nothing, not moving
        (0.0, 0.001, 0.0, 0.0),  # switched off
        (0.02, 0.03, 0.0, 0.0),  # holds an object
        (0.02, 0.001, 0.025, 0.0),  # pushes
    ],
)
def test_reopen_heuristic(reopen, width, moved, opened):
    acting = policy(CLOSED, CLOSED, temporal_ensemble_coeff=2.0, reopen=reopen)
    assert act(acting, width=width)[0, 6] == 0.0
    assert act(acting, [HERE[0] + moved, *HERE[1:]], width=width)[0, 6] == opened


def test_older_chunks_do_not_keep_an_empty_gripper_closed():
    """Five of six predictions, of equal weight, say closed."""
    acting = policy(*[[row(0.0, 0.0)] * 8] * 6, reopen=0.02)
    path = [[HERE[0] + 0.1 * place, *HERE[1:]] for place in range(5)]  # moves, then stops
    assert [act(acting, here)[0, 6] for here in [*path, path[-1]]] == [0, 0, 0, 0, 0, 1]


def test_reopen_heuristic_is_reset_with_the_episode():
    acting = policy(CLOSED, CLOSED, temporal_ensemble_coeff=2.0, reopen=0.02)
    for _ in range(2):
        acting.reset([start(0)])
        assert act(acting)[0, 6] == 0.0


def test_motions_are_in_the_frame_of_the_tcp():
    turned = [0.5, 0, 0.3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # 90 degrees about z
    quarter = [0.1, 0, 0, 0, 1, 0, -1, 0, 0, 0.2]  # 0.1 along its x axis, and 90 degrees about its z axis
    assert act(policy([quarter]), turned)[0] == pytest.approx([0.1, 0, 0, 0, 0, np.pi / 2, 0], abs=1e-6)
