"""Invalid answers of policy servers end the episode with a reason; the run continues."""

import socket as sockets
import threading
import time

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from counting_env import CountingEnv, run_policy
from remote_ends import (
    SHORT_TIMEOUTS,
    RecordingPolicy,
    make_episode,
    make_observations,
    serve_answer,
    serve_connections,
    serving,
)

from robocas_ms3.core.errors import EvaluationError, PolicyError
from robocas_ms3.evaluation.remote.client import RemotePolicy
from robocas_ms3.evaluation.remote.connection import MAX_ANSWER
from robocas_ms3.evaluation.remote.wire import encode_message


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        ("Traceback (most recent call last):\n  ...\nValueError: no cuda\n", "server failed: ValueError: no cuda"),
        (b"\xc1garbage", "invalid message"),
        (b"", "invalid message"),
        (encode_message(7), "invalid actions"),
        (encode_message({"actions": "up"}), "invalid actions"),
        (encode_message({"actions": [[1.0], [1.0, 2.0]]}), "invalid actions"),
        (encode_message({"actions": np.zeros((1, 8))}), r"expected numbers of shape \(H, 7\), found \(1, 8\)"),
        (encode_message({"actions": np.zeros((0, 7))}), "invalid actions"),
        (encode_message({"actions": np.zeros((1, 2, 7))}), "invalid actions"),
        (encode_message({"actions": np.full((1, 7), np.nan)}), "out of range"),
        (encode_message({"actions": np.full((1, 7), 1e30)}), "out of range"),
        (encode_message({"x": bytes(MAX_ANSWER)}), "lost connection"),
        (lambda socket, _: socket.close(), "lost connection"),
        (lambda socket, _: socket.socket.shutdown(sockets.SHUT_RDWR), "lost connection"),
    ],
    ids=range(14),
)
def test_invalid_answer_ends_the_episode(reply, reason):
    with serve_answer(reply) as url:
        remote = RemotePolicy(url)
        remote.reset([make_episode(0)])
        with pytest.raises(PolicyError, match=reason):
            remote.act(make_observations(0))


def test_missing_answer_ends_the_episode():
    with serve_answer(lambda socket, _: time.sleep(1)) as url:
        remote = RemotePolicy(f"{url}?timeout_s=0.5")
        remote.reset([make_episode(0)])
        with pytest.raises(PolicyError, match="no answer from the policy server within 0.5 s"):
            remote.act(make_observations(0))


GOOD = {"actions": [[0.0] * 7]}  # actions may be lists


@pytest.mark.parametrize(
    ("answer", "failed"),
    [
        *((bad, {0, 1}) for bad in (7, {}, GOOD, *({"batch": batch} for batch in ({}, [], [GOOD], [GOOD] * 3)))),
        ({"batch": [GOOD, 7]}, {0, 1}),
        ({"batch": np.zeros((2, 1, 7))}, {0, 1}),
        ({"batch": [GOOD, {}]}, {1}),
        ({"batch": [GOOD, {"error": 7}]}, {1}),
        ({"batch": [GOOD, {"error": "a\nb\x1b[31m"}]}, {1}),
        ({"batch": [{"actions": np.full((1, 7), np.nan)}, GOOD]}, {0}),
        ({"batch": [GOOD, {"actions": np.zeros((2, 7))}]}, {1}),  # chunks of another length
    ],
    ids=range(14),
)
def test_invalid_batch_answer_ends_its_episodes(answer, failed):
    with serve_answer(encode_message(answer), {"robocas_max_batch": 8}) as url:
        remote = RemotePolicy(url)
        remote.reset([make_episode(0), make_episode(1)])
        with pytest.raises(PolicyError) as raised:
            remote.act(make_observations(0, 1))
        remote.close()
    assert raised.value.reasons.keys() == failed
    assert all(reason.isprintable() for reason in raised.value.reasons.values())


SPECS = (
    *({"convention": "telepathy"}, {"cameras": {"base_camera": [0, 10**9]}}, {"rate_hz": float("nan")}),
    *({"depth": 1}, {"more": 1}, np.zeros(3)),
)


@pytest.mark.parametrize(
    "first",
    [
        "Traceback: no",
        b"\xc1",
        None,
        *(encode_message({"robocas_spec": spec}) for spec in SPECS),
        *(encode_message({"robocas_max_batch": value}) for value in (0, -1, True, 1.5, "8", [])),
        encode_message({"robocas_answers_pings": 1}),
        *(encode_message({"robocas_policy": {"weights": weights}}) for weights in (b"no text", "x" * 2**21)),
    ],
    ids=range(18),
)
def test_invalid_metadata_is_an_error_before_the_first_episode(first):
    def talk(socket):
        time.sleep(1) if first is None else socket.send(first)

    with serve_connections(talk) as url, pytest.raises(EvaluationError):
        RemotePolicy(f"{url}?{SHORT_TIMEOUTS}")


@pytest.mark.parametrize("said", [b"SSH-2.0-OpenSSH_9.6\r\n", b"HTTP/1.1 200 OK\r\n\r\nhello", b"\x00" * 99999, b""])
def test_other_programs_on_the_port_are_an_error(said):
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
        with pytest.raises(EvaluationError, match="no connection to the policy server within"):
            RemotePolicy(f"ws://127.0.0.1:{server.getsockname()[1]}?{SHORT_TIMEOUTS}")
        server.shutdown(sockets.SHUT_RDWR)


def test_timeout_if_the_server_does_not_read():
    def talk(socket):
        socket.send(encode_message({}))
        time.sleep(2)

    with serve_connections(talk) as url:
        remote = RemotePolicy(f"{url}?timeout_s=0.5&cameras=base_camera:6x4")
        remote.reset([make_episode(0)])
        seen = make_observations(0)
        seen.images["base_camera"] = np.zeros((1, 4096, 4096, 3), np.uint8)  # more than the socket buffer
        with pytest.raises(PolicyError, match="no answer from the policy server within"):
            remote.act(seen)


class FailingEveryThird(RecordingPolicy):
    """Policy that raises in every third episode."""

    def act(self, observations):
        if self.episodes[-1].episode % 3 == 2:
            raise RuntimeError("out of memory")
        return super().act(observations)


def test_run_continues_after_policy_errors_and_ends_without_a_server():
    env, starts = CountingEnv(1, 4, steps=True), [make_episode(-1, episode=number) for number in range(7)]
    with serving(FailingEveryThird()) as url:
        remote = RemotePolicy(f"{url}?{SHORT_TIMEOUTS}")
        ended = {one.spec.episode: one for one in run_policy(env, remote, starts, 10)}
    assert {number: one.steps for number, one in ended.items()} == {0: 4, 1: 4, 2: 0, 3: 4, 4: 4, 5: 0, 6: 4}
    assert {number for number, one in ended.items() if one.error} == {2, 5}
    assert ended[2].error == "the policy server failed: RuntimeError: out of memory"
    with pytest.raises(EvaluationError, match="no connection to the policy server within 0.5 s"):
        run_policy(env, remote, starts, 10)
    remote.close()
