"""Servers that take the observations of all envs in one request."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from counting_env import CountingEnv
from remote_ends import IN_A_HURRY, Told, a_start, serving, some_observations, talking
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from robocas_ms3.core.errors import EvaluationError, PolicyFailed
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.remote.client import RemotePolicy
from robocas_ms3.evaluation.remote.messages import batch_limit, message_bytes, observation_message
from robocas_ms3.evaluation.remote.wire import MAX_BYTES, pack
from robocas_ms3.evaluation.rollout import EndConditions, EpisodeBatch, rollout

GARBAGE = 1008


class SharedNoise(Told):
    """Draw the noise of all envs of a call from one generator, so that an outcome follows from the calls."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[list[int], list[int]]] = []
        self._rng = np.random.default_rng(0)
        self._started: list[int] = []

    def reset(self, starts):
        super().reset(starts)
        self._started = [start.env for start in starts]
        self._rng.bytes(len(starts))

    def act(self, observations):
        self.calls.append((self._started, observations.envs.tolist()))
        self._started = []
        noise = self._rng.normal(size=(len(observations.envs), 2, 7)).astype(np.float32)
        return noise * observations.tcp_in_base[:, None] + noise.mean()


def play(policy):
    """Play eight episodes in three envs that end after different numbers of steps."""
    env = CountingEnv(3, np.array([3, 4, 7]), steps=True)
    starts = [a_start(-1, episode=number, seed=number) for number in range(8)]
    batch = EpisodeBatch(env, policy.spec, EndConditions(9), 0.05, refill=True)
    return [replace(one, inference_seconds=0.0) for one in rollout(batch, policy, starts)], env.actions


def test_a_remote_run_is_equal_to_a_local_run_bit_for_bit():
    local, served = SharedNoise(), SharedNoise()
    expected, expected_actions = play(local)
    with serving(served) as url:
        remote = RemotePolicy(url)
        played, actions = play(remote)
        remote.close()
    assert served.calls == local.calls
    assert any(envs != sorted(envs) for _, envs in local.calls), "the order of rows would not be tested"
    assert served.starts == local.starts
    assert played == expected
    assert [step.tobytes() for step in actions] == [step.tobytes() for step in expected_actions]


def test_a_batch_of_the_announced_size_fits_in_a_message():
    for camera in ((8, 8), (224, 224), (640, 480), (4096, 4096)):
        spec = PolicySpec(cameras=dict.fromkeys(("base_camera", "gripper_camera", "static_camera"), camera), depth=True)
        envs = batch_limit(spec, 256)
        images = 3 * camera[0] * camera[1] * 5
        assert envs == 1 or envs * images + 4 * 2**20 <= message_bytes(spec, envs) <= MAX_BYTES
        assert batch_limit(spec, 1) == 1


class FailingIn(Told):
    """Fail in one env by `PolicyFailed`, and in another one by an exception."""

    failing, raising = 1, 4

    def act(self, observations):
        actions = super().act(observations)
        if self.raising in observations.envs:
            raise RuntimeError("out of memory")
        if self.failing in observations.envs:
            raise PolicyFailed({self.failing: "no\nplan"}, actions)
        return actions


def test_batches_are_split_and_failures_end_their_episodes_alone():
    policy = FailingIn()
    with serving(policy, max_batch=2) as url:
        remote = RemotePolicy(url)
        remote.reset([a_start(env) for env in range(6)])
        seen = some_observations(0, 1, 2, 3, 4, 5)
        with pytest.raises(PolicyFailed) as failed:
            remote.act(seen)
        assert [one.envs.tolist() for one in policy.seen] == [[0, 1], [2, 3], [4, 5]]
        exception = "the server failed: RuntimeError: out of memory"
        assert failed.value.reasons == {1: "the server failed: no plan", 4: exception, 5: exception}
        np.testing.assert_array_equal(failed.value.actions[[0, 2, 3]], Told().act(seen)[[0, 2, 3]])
        remote.close()


def test_an_env_that_failed_starts_another_episode():
    policy = FailingIn()
    seen = some_observations(0, 1, 2)
    with serving(policy) as url:
        remote = RemotePolicy(url)
        remote.reset([a_start(env) for env in range(3)])
        with pytest.raises(PolicyFailed):
            remote.act(seen)
        assert remote.act(some_observations(0, 2)).shape == (2, 3, 7)
        with pytest.raises(PolicyFailed, match="connection is lost"):
            remote.act(some_observations(1))
        policy.failing = -1
        remote.reset([a_start(1, episode=9)])
        assert remote.act(seen).shape == (3, 3, 7)
        remote.close()
    assert policy.starts[3:] == [a_start(1, episode=9)]


GOOD = {"actions": np.zeros((1, 7))}


@pytest.mark.parametrize(
    ("answer", "failed"),
    [
        (7, {0, 1}),
        ({}, {0, 1}),
        (GOOD, {0, 1}),
        ({"batch": {}}, {0, 1}),
        ({"batch": []}, {0, 1}),
        ({"batch": [GOOD]}, {0, 1}),
        ({"batch": [GOOD] * 3}, {0, 1}),
        ({"batch": [GOOD, 7]}, {0, 1}),
        ({"batch": np.zeros((2, 1, 7))}, {0, 1}),
        ({"batch": [GOOD, {}]}, {1}),
        ({"batch": [GOOD, {"error": 7}]}, {1}),
        ({"batch": [GOOD, {"error": "a\nb\x1b[31m"}]}, {1}),
        ({"batch": [{"actions": np.full((1, 7), np.nan)}, GOOD]}, {0}),
        ({"batch": [GOOD, {"actions": np.zeros((2, 7))}]}, {1}),
    ],
    ids=range(14),
)
def test_a_bad_answer_to_a_batch(answer, failed):
    def talk(socket):
        socket.send(pack({"robocas_max_batch": 8}))
        for _ in socket:
            socket.send(pack(answer))

    with talking(talk) as url:
        remote = RemotePolicy(f"{url}?{IN_A_HURRY}")
        remote.reset([a_start(0), a_start(1)])
        with pytest.raises(PolicyFailed) as raised:
            remote.act(some_observations(0, 1))
        remote.close()
    assert raised.value.reasons.keys() == failed
    assert all(reason.isprintable() for reason in raised.value.reasons.values())


@pytest.mark.parametrize(
    "metadata",
    [*({"robocas_max_batch": value} for value in (0, -1, True, 1.5, "8", [])), {"robocas_answers_pings": 1}],
)
def test_an_announcement_out_of_range_is_an_error(metadata):
    with talking(lambda socket: socket.send(pack(metadata))) as url, pytest.raises(EvaluationError, match="invalid"):
        RemotePolicy(f"{url}?{IN_A_HURRY}")


def message(env=0, start=None, **more):
    made = observation_message(some_observations(env), 0, a_start(env), reset=True)
    return made | {"start": made["start"] | (start or {})} | more


@pytest.mark.parametrize(
    "request_",
    [
        *({"batch": batch} for batch in (7, [], {}, [7])),
        {"batch": [message(), message()]},
        {"batch": [message(env) for env in range(5)]},
        {"batch": [message(), message(1, env_id="1")]},
        {"batch": [message(), message(1, **{"observation/qpos": np.zeros(3, np.float32)})]},
        {"batch": [message(), message(1, reset=False)]},
        {"batch": [{"batch": [message()]}]},
        *(message(start=start) for start in ({"seed": -1}, {"seed": 2**62}, {"episode": -1}, {"env": 0})),
        message(start={"instruction": "x" * 100_000}),
        message(prompt="x" * 100_000),
    ],
    ids=range(16),
)
def test_an_invalid_request_is_one_line_to_its_client(request_):
    policy = Told()
    with serving(policy, max_batch=4) as url, connect(url, proxy=None, compression=None) as client:
        client.recv()
        client.send(pack(request_))
        answer = client.recv(20)
        with pytest.raises(ConnectionClosed):
            client.recv(20)
    assert isinstance(answer, str) and answer.isprintable()
    assert (client.close_code, policy.seen, policy.starts) == (GARBAGE, [], [])


def test_embeddings_of_a_batch_have_one_length():
    policy = Told(PolicySpec(language="embedding"))
    embedded = [message(env, **{"observation/embedding": np.zeros(384 - env, np.float32)}) for env in range(2)]
    with serving(policy) as url, connect(url, proxy=None, compression=None) as client:
        client.recv()
        client.send(pack({"batch": embedded}))
        assert "differ in shape" in client.recv(20)
    assert policy.seen == []
