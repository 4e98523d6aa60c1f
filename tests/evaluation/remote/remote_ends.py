"""Fake observations, and servers in threads that end with the test."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from robocas_ms3.core.paths import protocols_dir
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec

CAMERA = (6, 4)  # width, height
SHORT_TIMEOUTS = "timeout_s=0.5&connect_s=0.5"  # options of an address


def make_episode(env: int = 0, episode: int = 3, seed: int = 7) -> EpisodeSpec:
    smoke, name = protocols_dir() / "smoke", "pick_table_scattered"
    files = (str(smoke / f"configs/{name}.yaml"), str(smoke / f"layouts/{name}.npy"))
    return EpisodeSpec(env, episode, "pick", *files, "builtin", seed, "take the apple")


def make_observations(*envs: int, cameras: bool = False) -> Observations:
    rng, count = np.random.default_rng(0), len(envs)
    width, height = CAMERA
    shape = (count, height, width)
    return Observations(
        envs=np.array(envs),
        instructions=["take the apple"] * count,
        embeddings=None,
        images={"base_camera": rng.integers(0, 256, (*shape, 3), np.uint8)} if cameras else {},
        depths={"base_camera": rng.integers(0, 999, (*shape, 1), np.int16)} if cameras else {},
        robot={
            "qpos": rng.normal(size=(count, 12)).astype(np.float32),
            "tcp_in_base": rng.normal(size=(count, 7)).astype(np.float32),
            "gripper_width": rng.normal(size=(count, 1)).astype(np.float32),
        },
        state=rng.normal(size=(count, 9)).astype(np.float32) if cameras else None,
        intrinsics={"base_camera": rng.normal(size=(count, 3, 3)).astype(np.float32)} if cameras else {},
        camera_in_base={"base_camera": rng.normal(size=(count, 4, 4)).astype(np.float32)} if cameras else {},
    )


class RecordingPolicy:
    """Policy that records its inputs and computes actions from its observations."""

    def __init__(self, spec: PolicySpec | None = None) -> None:
        self.spec = spec or PolicySpec()
        self.episodes: list[EpisodeSpec] = []
        self.seen: list[Observations] = []

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        self.episodes += episodes

    def act(self, observations: Observations) -> np.ndarray:
        self.seen.append(observations)
        return np.repeat(observations.tcp_in_base[:, None, :7].astype(float), 3, axis=1)


@contextmanager
def serving(policy: Any, port: int = 0, **options: Any) -> Iterator[str]:
    """Serve a policy; yield the address."""
    from robocas_ms3.evaluation.remote.server import PolicyServer

    server, addresses, ready = PolicyServer(policy, port=port, **options), [], threading.Event()

    def listening(url: str) -> None:
        addresses.append(url)
        ready.set()

    thread = threading.Thread(target=server.run, args=(listening,), daemon=True)
    thread.start()
    assert ready.wait(20)
    try:
        yield addresses[0]
    finally:
        server.stop()
        thread.join(20)


@contextmanager
def serve_connections(talk: Callable[[Any], None]) -> Iterator[str]:
    """Run a server with a function for each connection; yield the address."""
    from websockets.sync.server import serve

    with serve(talk, "127.0.0.1", 0, compression=None, max_size=None, close_timeout=0.1) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()


def serve_answer(answer: Any, metadata: dict[str, Any] | None = None) -> Any:
    """Run a server with a fixed answer, or with a function of the connection and the message."""
    from robocas_ms3.evaluation.remote.wire import encode_message

    def talk(socket: Any) -> None:
        socket.send(encode_message(metadata or {}))
        for data in socket:
            reply = answer(socket, data) if callable(answer) else answer
            if reply is not None:
                socket.send(reply)

    return serve_connections(talk)
