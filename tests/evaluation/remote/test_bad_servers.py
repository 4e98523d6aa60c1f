"""Servers that are not what they should be: an episode fails, with a reason, and the run goes on."""

import socket as sockets
import threading
import time

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from counting_env import CountingEnv
from remote_ends import IN_A_HURRY, Told, a_start, serving, some_observations, talking

from robocas_ms3.core.errors import EvaluationError, PolicyFailed
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.protocol import Episode
from robocas_ms3.evaluation.remote.client import RemotePolicy
from robocas_ms3.evaluation.remote.connection import MAX_ANSWER
from robocas_ms3.evaluation.remote.wire import pack
from robocas_ms3.evaluation.rollout import EndConditions, EpisodeBatch, rollout


def answering(reply):
    """A server with this answer; a callable does what it likes with the connection."""

    def talk(socket):
        socket.send(pack({}))
        for _ in socket:
            if callable(reply):
                reply(socket)
            else:
                socket.send(reply)

    return talking(talk)


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        ("Traceback (most recent call last):\n  ...\nValueError: no cuda\n", "server failed: ValueError: no cuda"),
        (b"\xc1garbage", "invalid message"),
        (b"", "invalid message"),
        (pack(7), "no actions"),
        (pack({"actions": "up"}), "no actions"),
        (pack({"actions": [[1.0], [1.0, 2.0]]}), "no actions"),
        (pack({"actions": np.zeros((1, 8))}), r"expected \(chunk, 7\) numbers, found \(1, 8\)"),
        (pack({"actions": np.zeros((0, 7))}), "no actions"),
        (pack({"actions": np.zeros((1, 2, 7))}), "no actions"),
        (pack({"actions": np.full((1, 7), np.nan)}), "out of range"),
        (pack({"actions": np.full((1, 7), 1e30)}), "out of range"),
        (pack({"x": bytes(MAX_ANSWER)}), "connection is lost"),
        (lambda socket: time.sleep(1), "no answer within 0.5 s"),
        (lambda socket: socket.close(), "connection is lost"),
        (lambda socket: socket.socket.shutdown(sockets.SHUT_RDWR), "connection is lost"),
    ],
    ids=range(15),
)
def test_a_bad_answer_fails_the_episode(reply, reason):
    with answering(reply) as url:
        remote = RemotePolicy(f"{url}?{IN_A_HURRY}")
        remote.reset([a_start(0)])
        with pytest.raises(PolicyFailed, match=reason):
            remote.act(some_observations(0))


@pytest.mark.parametrize(
    "talk",
    [
        lambda socket: socket.send("Traceback: no"),
        lambda socket: socket.send(b"\xc1"),
        lambda socket: socket.send(pack({"robocas_wants": {"convention": "telepathy"}})),
        lambda socket: socket.send(pack({"robocas_wants": {"cameras": {"base_camera": [0, 10**9]}}})),
        lambda socket: socket.send(pack({"robocas_wants": {"rate_hz": float("nan")}})),
        lambda socket: socket.send(pack({"robocas_wants": {"depth": 1}})),
        lambda socket: socket.send(pack({"robocas_wants": {"more": 1}})),
        lambda socket: socket.send(pack({"robocas_wants": np.zeros(3)})),
        lambda socket: time.sleep(1),
        lambda socket: socket.close(),
    ],
    ids=range(10),
)
def test_bad_metadata_are_an_error_before_anything_is_played(talk):
    with talking(talk) as url, pytest.raises(EvaluationError):
        RemotePolicy(f"{url}?{IN_A_HURRY}")


@pytest.mark.parametrize("said", [b"SSH-2.0-OpenSSH_9.6\r\n", b"HTTP/1.1 200 OK\r\n\r\nhello", b"\x00" * 99999, b""])
def test_something_else_listens(said):
    with sockets.create_server(("127.0.0.1", 0)) as server:

        def talk():
            while True:
                try:
                    client, _ = server.accept()
                except OSError:
                    return
                client.sendall(said)
                client.close()

        threading.Thread(target=talk, daemon=True).start()
        with pytest.raises(EvaluationError, match="no server within"):
            RemotePolicy(f"ws://127.0.0.1:{server.getsockname()[1]}?{IN_A_HURRY}")
        server.shutdown(sockets.SHUT_RDWR)


def test_a_server_that_does_not_read_is_not_waited_for():
    def talk(socket):
        socket.send(pack({}))
        time.sleep(2)

    with talking(talk) as url:
        remote = RemotePolicy(f"{url}?timeout_s=0.5&cameras=base_camera:6x4")
        remote.reset([a_start(0)])
        seen = some_observations(0)
        seen.images["base_camera"] = np.zeros((1, 4096, 4096, 3), np.uint8)  # more than a socket holds
        with pytest.raises(PolicyFailed, match="no answer within"):
            remote.act(seen)


def test_the_next_episode_finds_a_server_that_came_back_with_the_same_policy():
    with serving(Told()) as url:
        remote = RemotePolicy(f"{url}?{IN_A_HURRY}")
        remote.reset([a_start(0), a_start(1)])
        remote.act(some_observations(0, 1))
    port = int(url.rpartition(":")[2])
    policy = Told()
    with serving(policy, port):
        remote.reset([a_start(1, episode=9)])
        with pytest.raises(PolicyFailed, match="connection is lost") as failed:
            remote.act(some_observations(0, 1))
        assert failed.value.reasons.keys() == {0}
        assert policy.starts == [a_start(1, episode=9)]
    with serving(Told(PolicySpec(convention="delta_euler")), port):
        remote.reset([a_start(0)])
        with pytest.raises(EvaluationError, match="another policy is served now"):
            remote.act(some_observations(0))
    remote.close()


class Stumbling(Told):
    """Raises in every third episode."""

    def act(self, observations):
        if self.starts[-1].episode % 3 == 2:
            raise RuntimeError("out of memory")
        return super().act(observations)


def play(policy, count=7, envs=2):
    batch = EpisodeBatch(CountingEnv(envs, 4, steps=True), policy.spec, EndConditions(10), 0.05, refill=True)
    starts = [a_start(-1, episode=number) for number in range(count)]
    return {one.start.episode: one for one in rollout(batch, policy, starts)}


def test_a_run_continues_after_episodes_in_which_the_policy_fails():
    with serving(Stumbling()) as url:
        played = play(RemotePolicy(url), envs=1)
    assert {number: one.steps for number, one in played.items()} == {0: 4, 1: 4, 2: 0, 3: 4, 4: 4, 5: 0, 6: 4}
    assert {number for number, one in played.items() if one.error} == {2, 5}
    assert played[2].error == "the server failed: RuntimeError: out of memory"
    outcome = played[2].outcome(Episode(episode=2, task="pick", config="x", seed=7, instruction="", target="a"), ())
    assert (outcome.failure_stage, outcome.error, outcome.success) == ("error", played[2].error, False)


def test_a_run_ends_when_its_server_can_not_be_reached_again():
    with serving(Told()) as url:
        remote = RemotePolicy(f"{url}?{IN_A_HURRY}")
    start = time.monotonic()
    with pytest.raises(EvaluationError, match="no server within 0.5 s"):
        play(remote, count=50)
    assert time.monotonic() - start < 10  # it waits for connect_s once, not once per episode
    remote.close()


class Hopeless(Told):
    """Fails in the first env."""

    def act(self, observations):
        if 0 in observations.envs:
            raise PolicyFailed({0: "zero"}, super().act(observations) if len(observations.envs) > 1 else None)
        return super().act(observations)


def test_others_act_where_one_fails():
    played = play(Hopeless(), count=5, envs=2)
    assert len(played) == 5
    assert {one.error for one in played.values() if one.start.env == 0} == {"zero"}
    assert {one.steps for one in played.values() if one.start.env == 1} == {4}
