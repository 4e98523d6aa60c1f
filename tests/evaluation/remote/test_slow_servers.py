"""Slow servers, parallel requests, and lost networks."""

import asyncio
import multiprocessing
import os
import socket as sockets
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from remote_ends import RecordingPolicy, make_episode, make_observations, serve_answer, serving
from websockets.asyncio.server import serve
from websockets.sync.client import connect

from robocas_ms3.core.errors import PolicyError
from robocas_ms3.evaluation.remote import connection
from robocas_ms3.evaluation.remote.client import RemotePolicy
from robocas_ms3.evaluation.remote.messages import make_observation_message
from robocas_ms3.evaluation.remote.wire import decode_message, encode_message

ENVS = 5


class Slow(RecordingPolicy):
    """Policy with a delay per call."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds, self.entered = seconds, threading.Event()

    def act(self, observations):
        self.entered.set()
        time.sleep(self.seconds)
        return super().act(observations)


@pytest.fixture
def fast_pings(monkeypatch):
    """Shorten ping intervals and timeouts."""
    monkeypatch.setattr(connection, "PING_INTERVAL", 0.2)
    monkeypatch.setattr(connection, "PING_TIMEOUT", 3.0)


def with_numbers(answer):
    """Run a server that answers with a function of the env, with one thread per connection."""
    return serve_answer(
        lambda _, data: encode_message({"actions": np.full((1, 7), answer(decode_message(data)["env_id"]))})
    )


def started(url):
    remote = RemotePolicy(url)
    remote.reset([make_episode(env) for env in range(ENVS)])
    return remote


@pytest.mark.parametrize("in_turn", [True, False])
def test_requests_of_all_envs_are_sent_together_or_in_order(in_turn):
    """The time limit restarts with each answer of a server that computes one answer after another."""
    asked, turn, arrived = [], threading.Lock(), threading.Barrier(1 if in_turn else ENVS)

    def answer(env):
        arrived.wait(20)  # no answer before all requests have arrived
        assert turn.acquire(blocking=not in_turn)
        asked.append(env)
        time.sleep(0.1 if in_turn else 0.9)
        turn.release()
        return env

    with with_numbers(answer) as url:
        remote = started(f"{url}?{'max_in_flight=1' if in_turn else 'timeout_s=4'}")
        for order in ([0, 1, 2, 3, 4], [3, 0, 4, 2, 1]):  # the order of answers has no effect
            assert remote.act(make_observations(*order))[:, 0, 0].tolist() == order
        remote.close()
    assert asked == [0, 1, 2, 3, 4, 3, 0, 4, 2, 1] or not in_turn


def blocking_server(pipe):
    """Run a server like openpi's: no pings and no new connections during inference."""

    async def talk(client):
        await client.send(encode_message({}))
        async for data in client:
            time.sleep(2.5)
            await client.send(encode_message({"actions": np.full((1, 7), decode_message(data)["env_id"])}))

    async def run():
        async with serve(talk, "127.0.0.1", 0, compression=None, max_size=None) as server:
            pipe.send(next(iter(server.sockets)).getsockname()[1])
            await server.serve_forever()

    asyncio.run(run())


def test_connections_are_opened_before_the_first_request():
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    server = context.Process(target=blocking_server, args=(theirs,), daemon=True)
    server.start()
    try:
        remote = started(f"ws://127.0.0.1:{ours.recv()}?connect_s=2")
        assert remote.act(make_observations(0, 1, 2))[:, 0, 0].tolist() == [0, 1, 2]
        remote.close()
    finally:
        server.terminate()
        server.join()


def test_timeout_ends_only_the_episode_of_its_env():
    ended = threading.Event()

    def answer(env):
        if env == 2:
            ended.wait(20)
        return env

    with with_numbers(answer) as url:
        remote = started(f"{url}?timeout_s=1")
        with pytest.raises(PolicyError) as failed:
            remote.act(make_observations(*range(ENVS)))
        ended.set()
        assert failed.value.reasons == {
            2: "no answer from the policy server within 1 s. Increase the option timeout_s of the address."
        }
        assert failed.value.actions[[0, 1, 3, 4], 0, 0].tolist() == [0, 1, 3, 4]
        remote.reset([make_episode(2)])
        assert remote.act(make_observations(2, 3))[:, 0, 0].tolist() == [2, 3]
        remote.close()


def test_slow_server_stays_connected_and_answers_health_checks(fast_pings):
    policy = Slow(6.0)  # twice the ping timeout
    with serving(policy) as url:
        remote = started(url)
        answers = []
        asking = threading.Thread(target=lambda: answers.append(remote.act(make_observations(0))))
        asking.start()
        assert policy.entered.wait(20)
        with urllib.request.urlopen(url.replace("ws", "http", 1) + "/healthz", timeout=3) as health:
            assert health.status == 200
        assert asking.is_alive()
        asking.join(30)
        assert answers[0].shape == (1, 3, 7)
        remote.close()


@contextmanager
def tunnel(port, cut):
    """Forward connections to a port; after the event no data pass and no connection is closed."""

    def forward(source, sink):
        while data := source.recv(2**16):
            if not cut.is_set():
                sink.sendall(data)

    with sockets.create_server(("127.0.0.1", 0)) as server:

        def accept():
            while True:
                try:
                    near, _ = server.accept()
                except OSError:
                    return
                far = sockets.create_connection(("127.0.0.1", port))
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=forward, args=pair, daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        yield f"ws://127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(sockets.SHUT_RDWR)


def test_both_ends_detect_a_lost_network(fast_pings):
    policy, cut = RecordingPolicy(), threading.Event()
    with serving(policy) as url, tunnel(int(url.rpartition(":")[2]), cut) as address:
        remote = RemotePolicy(f"{address}?timeout_s=60")
        remote.reset([make_episode(0)])
        remote.act(make_observations(0))
        cut.set()
        with pytest.raises(PolicyError, match="keepalive ping timeout"):
            remote.act(make_observations(0))
        for _ in range(100):  # until the server has released the env
            other = RemotePolicy(url)
            other.reset([make_episode(0)])
            other.act(make_observations(0))
            other.close()
            if policy.episodes[-1].env == 0:
                return
            time.sleep(0.2)
        pytest.fail("the server keeps the env of a client that is gone")


def test_requests_of_disconnected_clients_are_skipped():
    policy = Slow(1.0)

    def ask(url):
        client = connect(url, proxy=None, compression=None)
        client.recv()
        client.send(encode_message(make_observation_message(make_observations(0), 0, make_episode(), reset=True)))
        return client

    with serving(policy) as url:
        first = ask(url)
        assert policy.entered.wait(20)
        ask(url).close()
        last = ask(url)
        for client in (first, last):
            assert decode_message(client.recv(20)).keys() == {"actions", "requests_images"}
        assert len(policy.seen) == 2
        first.close()
        last.close()


CUT = """
import os, subprocess, sys, threading, time
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
from remote_ends import make_episode, serve_answer, make_observations
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.remote import connection
from robocas_ms3.evaluation.remote.client import RemotePolicy

connection.TCP_OPTIONS = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 2}

with serve_answer(lambda *_: time.sleep(1000)) as url:  # like openpi's server, without answers to pings
    policy = RemotePolicy(url + "?timeout_s=300&connect_s=0.5")
    policy.reset([make_episode(0)])
    threading.Timer(1, lambda: subprocess.run(["ip", "link", "set", "lo", "down"], check=True)).start()
    try:
        policy.act(make_observations(0))
    except EvaluationError as failed:
        print("no connection to the policy server within" in str(failed), flush=True)
    os._exit(0)
"""


def test_tcp_keepalive_detects_a_lost_network_without_pings():
    """In a separate network namespace whose only interface goes down."""
    words = ["unshare", "--map-root-user", "--user", "--net"]
    try:
        subprocess.run([*words, "ip", "link"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no network namespaces here")
    here = Path(__file__).resolve().parent
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(here), str(here.parents[2])])}
    words += [sys.executable, "-c", CUT]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=env, check=False)
    assert done.stdout == "True\n", done.stderr
