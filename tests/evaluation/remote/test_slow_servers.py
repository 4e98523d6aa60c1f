"""Slow servers are waited for, all of them at the same time, and a dead network is noticed."""

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

from remote_ends import Told, a_start, answering, serving, some_observations
from websockets.asyncio.server import serve
from websockets.sync.client import connect

from robocas_ms3.core.errors import PolicyError
from robocas_ms3.evaluation.remote import connection
from robocas_ms3.evaluation.remote.client import RemotePolicy
from robocas_ms3.evaluation.remote.messages import observation_message
from robocas_ms3.evaluation.remote.wire import pack, unpack

ENVS = 5


class Slow(Told):
    """Take a while per call."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds, self.entered = seconds, threading.Event()

    def act(self, observations):
        self.entered.set()
        time.sleep(self.seconds)
        return super().act(observations)


@pytest.fixture
def fast_pings(monkeypatch):
    """Shorten the times of pings."""
    monkeypatch.setattr(connection, "PING_INTERVAL", 0.2)
    monkeypatch.setattr(connection, "PING_TIMEOUT", 1.0)


def with_numbers(answer):
    """Serve what a function of the env's number returns, a thread per connection."""
    return answering(lambda _, data: pack({"actions": np.full((1, 7), answer(unpack(data)["env_id"]))}))


def started(url):
    remote = RemotePolicy(url)
    remote.reset([a_start(env) for env in range(ENVS)])
    return remote


@pytest.mark.parametrize("in_turn", [True, False])
def test_requests_of_all_envs_are_in_flight_together_or_in_their_order(in_turn):
    """Each answer has the time limit for itself where a server computes one after another."""
    asked, turn, arrived = [], threading.Lock(), threading.Barrier(1 if in_turn else ENVS)

    def answer(env):
        arrived.wait(20)  # nobody is answered before all have asked
        assert turn.acquire(blocking=not in_turn)
        asked.append(env)
        time.sleep(0.1 if in_turn else 0.3)
        turn.release()
        return env

    with with_numbers(answer) as url:
        remote = started(f"{url}?{'max_in_flight=1' if in_turn else 'timeout_s=1.2'}")
        for order in ([0, 1, 2, 3, 4], [3, 0, 4, 2, 1]):  # answers in any order belong to their envs
            assert remote.act(some_observations(*order))[:, 0, 0].tolist() == order
        remote.close()
    assert asked == [0, 1, 2, 3, 4, 3, 0, 4, 2, 1] or not in_turn


def blocking_server(pipe):
    """Serve as openpi does: nothing else happens during inference, neither pings nor new connections."""

    async def talk(client):
        await client.send(pack({}))
        async for data in client:
            time.sleep(0.8)
            await client.send(pack({"actions": np.full((1, 7), unpack(data)["env_id"])}))

    async def run():
        async with serve(talk, "127.0.0.1", 0, compression=None, max_size=None) as server:
            pipe.send(next(iter(server.sockets)).getsockname()[1])
            await server.serve_forever()

    asyncio.run(run())


def test_connections_are_opened_before_the_server_computes():
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    server = context.Process(target=blocking_server, args=(theirs,), daemon=True)
    server.start()
    try:
        remote = started(f"ws://127.0.0.1:{ours.recv()}?connect_s=0.6")
        assert remote.act(some_observations(0, 1, 2))[:, 0, 0].tolist() == [0, 1, 2]
        remote.close()
    finally:
        server.terminate()
        server.join()


def test_an_env_without_an_answer_fails_alone():
    ended = threading.Event()

    def answer(env):
        if env == 2:
            ended.wait(20)
        return env

    with with_numbers(answer) as url:
        remote = started(f"{url}?timeout_s=1")
        with pytest.raises(PolicyError) as failed:
            remote.act(some_observations(*range(ENVS)))
        ended.set()
        assert failed.value.reasons == {2: "no answer from the policy server within 1 s"}
        assert failed.value.actions[[0, 1, 3, 4], 0, 0].tolist() == [0, 1, 3, 4]
        remote.reset([a_start(2)])
        assert remote.act(some_observations(2, 3))[:, 0, 0].tolist() == [2, 3]
        remote.close()


def test_a_slow_server_is_not_dropped_and_answers_health_checks(fast_pings):
    policy = Slow(2.5)  # twice what an answer to a ping may take
    with serving(policy) as url:
        remote = started(url)
        answers = []
        asking = threading.Thread(target=lambda: answers.append(remote.act(some_observations(0))))
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
    """Forward connections to a port, until the event is set: then nothing passes, and nothing is closed."""

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


def test_a_dead_network_is_noticed_by_both_ends(fast_pings):
    policy, cut = Told(), threading.Event()
    with serving(policy) as url, tunnel(int(url.rpartition(":")[2]), cut) as address:
        remote = RemotePolicy(f"{address}?timeout_s=60&connect_s=1")
        remote.reset([a_start(0)])
        remote.act(some_observations(0))
        cut.set()
        with pytest.raises(PolicyError, match="keepalive ping timeout"):
            remote.act(some_observations(0))
        for _ in range(100):  # until the server has released the env
            other = RemotePolicy(url)
            other.reset([a_start(0)])
            other.act(some_observations(0))
            other.close()
            if policy.starts[-1].env == 0:
                return
            time.sleep(0.2)
        pytest.fail("the server keeps the env of a client that is gone")


def test_a_request_whose_client_is_gone_is_skipped():
    policy = Slow(1.0)

    def ask(url):
        client = connect(url, proxy=None, compression=None)
        client.recv()
        client.send(pack(observation_message(some_observations(0), 0, a_start(), reset=True)))
        return client

    with serving(policy) as url:
        first = ask(url)
        assert policy.entered.wait(20)
        ask(url).close()
        last = ask(url)
        assert unpack(first.recv(20)).keys() == unpack(last.recv(20)).keys() == {"actions"}
        assert len(policy.seen) == 2
        first.close()
        last.close()


CUT = """
import os, subprocess, sys, threading, time
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
from remote_ends import a_start, answering, some_observations
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.remote import connection
from robocas_ms3.evaluation.remote.client import RemotePolicy

connection.TCP_OPTIONS = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 2}

with answering(lambda *_: time.sleep(1000)) as url:  # a plain openpi server, which answers no pings
    policy = RemotePolicy(url + "?timeout_s=300&connect_s=0.5")
    policy.reset([a_start(0)])
    threading.Timer(1, lambda: subprocess.run(["ip", "link", "set", "lo", "down"], check=True)).start()
    try:
        policy.act(some_observations(0))
    except EvaluationError as failed:
        print("no connection to the policy server within" in str(failed), flush=True)
    os._exit(0)
"""


def test_tcp_keepalive_notices_a_dead_network_without_pings():
    """In a network namespace of its own, whose only interface goes down."""
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
