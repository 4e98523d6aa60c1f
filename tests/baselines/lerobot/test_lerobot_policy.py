"""LeRobotPolicy with a stub model: observations, queues per env, refused inputs. LeRobot is not needed."""

from collections import deque

import numpy as np
import pytest
import torch
from synthetic_observations import observe, start

from robocas_ms3.baselines.lerobot.policy import EMBEDDING, LeRobotPolicy, make_state, scale_embeddings
from robocas_ms3.baselines.lerobot.serve import load_policy, main, read_dataset_rate
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import describe_policy
from robocas_ms3.robots.quantities import STATE

INPUTS = {STATE: (17,), "observation.images.base_camera": (3, 2, 4), EMBEDDING: (384,)}
HALF = float(np.sqrt(0.5))


class Chunks(torch.nn.Module):
    """Model with chunks of three actions, as LeRobot's ACT: gripper width at the prediction, actions left, noise."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.ensembler = Ensembler()
        self.seen = []
        self.reset()

    def reset(self):
        self._queue = deque(maxlen=3)
        self.ensembler.reset()

    def select_action(self, batch):
        self.seen.append(batch)
        self.ensembler.count += 1
        if not self._queue:
            width = float(batch[STATE][0, -1])
            self._queue.extend(torch.tensor([[width, left, float(torch.rand(())), 0, 0, 0, 1]]) for left in (2, 1, 0))
        action = self._queue.popleft()
        action[0, 3] = self.ensembler.count
        return action


class Ensembler:
    def reset(self):
        self.count = 0


def preprocess(item):
    return {key: value[None] if isinstance(value, torch.Tensor) else value for key, value in item.items()}


def make_policy(model=None, inputs=None):
    return LeRobotPolicy(model or Chunks(), preprocess, lambda action: 2 * action, inputs or INPUTS, 5.0)


def observations(widths):
    """Return observations for gripper widths by env."""
    count = len(widths)
    images = np.zeros((count, 2, 4, 3), np.uint8)
    images[:, 0, 1] = 255, 0, 51
    return observe(
        list(widths),
        embeddings=np.tile(np.eye(384, dtype=np.float32)[:1], (count, 1)),
        images={"base_camera": images},
        qpos=np.tile(np.arange(12, dtype=np.float32), (count, 1)),
        tcp_in_base=np.tile(np.float32([0.1, 0.2, 0.3, HALF, 0, 0, HALF]), (count, 1)),  # 90 deg about z
        gripper_width=np.float32(list(widths.values()))[:, None],
    )


def test_the_spec_follows_from_the_checkpoint():
    spec = make_policy().spec
    assert (spec.convention, spec.reference, spec.rate_hz, spec.language) == ("robocas", "tcp", 5.0, "embedding")
    assert spec.cameras == {"base_camera": (4, 2)}
    assert make_policy(inputs={STATE: (17,)}).spec.language == "text"
    policy = LeRobotPolicy(Chunks(), preprocess, preprocess, INPUTS, 5.0, {"weights": "abc"})
    assert describe_policy(policy)["weights"] == "abc"


@pytest.mark.parametrize("key, shape", [(STATE, (18,)), (EMBEDDING, (7,)), ("observation.images.wrist", (3, 2, 4))])
def test_other_inputs_are_refused(key, shape):
    with pytest.raises(EvaluationError, match=f"{key}: unexpected input"):
        make_policy(inputs={**INPUTS, key: shape})


def test_an_observation_is_an_item_of_the_dataset():
    model = Chunks()
    policy = make_policy(model)
    policy.reset([start(0)])
    policy.act(observations({0: 0.07}))
    seen = model.seen[0]  # the list is shared by copies
    expected = [0.1, 0.2, 0.3, 0, 1, 0, -1, 0, 0, 3, 4, 5, 6, 7, 8, 9, 0.07]  # x axis along y, y axis along -x
    np.testing.assert_allclose(seen[STATE][0], expected, atol=1e-6)
    assert seen["observation.images.base_camera"].shape == (1, 3, 2, 4)
    np.testing.assert_allclose(seen["observation.images.base_camera"][0, :, 0, 1], [1, 0, 0.2])
    assert seen[EMBEDDING][0, 0] == pytest.approx(19.5959, abs=1e-4)  # sqrt(384)
    assert seen["task"] == "take it"
    assert set(make_policy_without_embedding(model)) == {STATE, "task"}


def make_policy_without_embedding(model):
    policy = make_policy(model, {STATE: (17,)})
    policy.reset([start(0)])
    policy.act(observations({0: 0.07}))
    return model.seen[-1]


def test_each_env_has_its_own_chunks():
    policy = make_policy()
    policy.reset([start(0), start(5)])
    assert policy.act(observations({0: 1, 5: 50}))[:, :2].tolist() == [[2, 4], [100, 4]]
    policy.reset([start(5)])  # starts again while env 0 continues its chunk
    assert policy.act(observations({0: 2, 5: 60}))[:, :2].tolist() == [[2, 2], [120, 4]]
    assert policy.act(observations({5: 61}))[:, :2].tolist() == [[120, 2]]
    actions = policy.act(observations({0: 3, 5: 62}))
    assert actions[:, :2].tolist() == [[2, 0], [120, 0]]
    assert actions[:, 3].tolist() == [6, 6]  # three calls each: the ensembler is not shared
    assert policy.act(observations({0: 4}))[0, 0] == 8  # the next chunk


def test_noise_depends_on_the_episode_seed_only():
    def noise(policy, env, others=()):
        return policy.act(observations({**dict.fromkeys(others, 1.0), env: 1.0}))[-1, 2]

    alone, among_others = make_policy(), make_policy()
    alone.reset([start(0, seed=7)])
    among_others.reset([start(1, seed=8), start(2, seed=7)])
    first = noise(alone, 0)
    assert noise(among_others, 2, others=[1]) == first
    assert noise(among_others, 1) != first


def test_sign_of_a_quaternion_does_not_matter():
    parts = np.zeros((1, 3)), np.array([[0.1, 0.2, 0.3, 0.4]]), np.zeros((1, 7)), np.zeros((1, 1))
    np.testing.assert_array_equal(make_state(*parts), make_state(parts[0], -parts[1], *parts[2:]))
    assert np.sqrt(np.mean(scale_embeddings(np.full((1, 384), 384**-0.5)) ** 2)) == pytest.approx(1)


def test_missing_checkpoint_is_a_one_line_error(tmp_path, capsys):
    with pytest.raises(EvaluationError, match="no LeRobot checkpoint"):
        load_policy(tmp_path, 5, "cpu", None)
    (tmp_path / "info.json").write_text('{"fps": 5}')
    assert read_dataset_rate(tmp_path / "info.json") == 5
    with pytest.raises(EvaluationError, match=r"Pass --rate HZ"):
        read_dataset_rate(tmp_path / "nothing.json")
    assert main([str(tmp_path), "--rate", "5"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "train_lerobot.sh" in error
