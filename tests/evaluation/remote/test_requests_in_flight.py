"""Servers without batches: a request per env, all in flight together."""

import asyncio
import multiprocessing
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from remote_ends import a_start, some_observations, talking
from websockets.asyncio.server import serve

from robocas_ms3.core.errors import PolicyFailed
from robocas_ms3.evaluation.remote.client import RemotePolicy
from robocas_ms3.evaluation.remote.wire import pack, unpack

PAGE = Path(__file__).resolve().parents[3] / "docs/remote_policies.md"
ENVS = 5


def answering(answer):
    """Serve what a function of the env's number returns, a thread per connection."""

    def talk(socket):
        socket.send(pack({}))
        for data in socket:
            value = answer(unpack(data)["env_id"])
            socket.send(pack({"actions": np.full((1, 7), value)}))

    return talking(talk)


def started(url):
    remote = RemotePolicy(url)
    remote.reset([a_start(env) for env in range(ENVS)])
    return remote


def test_one_request_at_a_time_comes_in_the_order_of_the_envs():
    asked, present = [], threading.Semaphore(1)

    def answer(env):
        assert present.acquire(blocking=False)
        asked.append(env)
        time.sleep(0.02)
        present.release()
        return env

    with answering(answer) as url:
        remote = started(f"{url}?max_in_flight=1")
        for _ in range(3):
            remote.act(some_observations(*range(ENVS)))
        remote.close()
    assert asked == [*range(ENVS)] * 3


def test_a_server_that_computes_one_answer_after_another_has_the_time_limit_for_each():
    turn, arrived = threading.Lock(), threading.Barrier(ENVS)  # nobody is answered before all have asked

    def answer(env):
        arrived.wait(20)
        with turn:
            time.sleep(0.5)
        return env

    with answering(answer) as url:
        remote = started(f"{url}?timeout_s=1.5")
        start = time.monotonic()
        for order in ([0, 1, 2, 3, 4], [3, 0, 4, 2, 1]):  # answers in any order belong to their envs
            assert remote.act(some_observations(*order))[:, 0, 0].tolist() == order
        assert time.monotonic() - start > 3
        remote.close()


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
        for _ in range(2):
            assert remote.act(some_observations(*range(ENVS)))[:, 0, 0].tolist() == [*range(ENVS)]
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

    with answering(answer) as url:
        remote = started(f"{url}?timeout_s=1")
        with pytest.raises(PolicyFailed) as failed:
            remote.act(some_observations(*range(ENVS)))
        ended.set()
        assert failed.value.reasons == {2: "no answer within 1 s"}
        assert failed.value.actions[[0, 1, 3, 4], 0, 0].tolist() == [0, 1, 3, 4]
        remote.reset([a_start(2)])
        assert remote.act(some_observations(2, 3))[:, 0, 0].tolist() == [2, 3]
        remote.close()


def test_the_server_of_the_documentation():
    pytest.importorskip("openpi_client")
    (program,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    serving = "    server.serve_forever()"
    assert '"127.0.0.1", 8000' in program and serving in program
    tell_port = "    print(server.socket.getsockname()[1], flush=True)\n"
    program = program.replace("8000", "0").replace(serving, tell_port + serving)
    served = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None
        remote = started(f"ws://127.0.0.1:{int(served.stdout.readline())}")
        assert dict(remote.spec.cameras) == {"base_camera": (224, 224)}
        seen = some_observations(*range(ENVS))
        seen.images["base_camera"] = np.zeros((ENVS, 224, 224, 3), np.uint8)
        assert remote.act(seen).shape == (ENVS, 5, 7)
        remote.close()
    finally:
        served.kill()
        served.communicate()
