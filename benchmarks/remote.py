"""Measure the observations per second of a remote policy with servers of a fixed inference time; print JSON.

python benchmarks/remote.py [--in-turn] [--inference-ms 100] [--rounds 20] [--images 224]

Each server runs in a process. Observations are synthetic, and nothing is simulated. Servers:
  serial     openpi's protocol, one request at a time, as openpi's server
  parallel   openpi's protocol, all requests at the same time, as with one process per connection
  batched    `robocas serve-policy`, which computes the actions of all envs in one call
JSON keys:
  inference_ms, images, rounds   options of the benchmark
  serial, parallel, batched      number of envs -> obs_per_s (observations per second) and act_ms (median time of
                                 a call of `act` in ms)
"""

import asyncio
import json
import multiprocessing
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import tyro
from websockets.asyncio.server import ServerConnection, serve

from robocas_ms3.evaluation import EpisodeSpec, Observations, PolicyServer, PolicySpec, RemotePolicy
from robocas_ms3.evaluation.remote.wire import encode_message

SERVERS = ("serial", "parallel", "batched")
CAMERAS = ("base_camera", "gripper_camera")
WARM_UP = 2  # rounds that are not measured
CHUNK = (10, 7)
SIZES = {"qpos": 12, "tcp_in_base": 7, "gripper_width": 1}


@dataclass
class Args:
    inference_ms: float = 100
    """Time that a server takes per request, or per call of the policy."""
    rounds: int = 20
    """Number of observations per env."""
    envs: tuple[int, ...] = (1, 2, 4, 8, 16)
    """Numbers of envs."""
    images: int = 224
    """Side of the images of two cameras, in pixels; 0: no images."""
    servers: tuple[str, ...] = SERVERS
    """Servers to measure: serial, parallel, batched."""
    in_turn: bool = False
    """Send the requests of the envs one after another: max_in_flight=1, and batches of one env."""


class SlowPolicy:
    """Take a fixed time per call."""

    def __init__(self, seconds: float, spec: PolicySpec) -> None:
        self.seconds, self.spec = seconds, spec

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Keep no state."""

    def act(self, observations: Observations) -> np.ndarray:
        """Return (E, H, 7) zeros."""
        time.sleep(self.seconds)
        return np.zeros((len(observations.envs), *CHUNK))


def main(args: Args) -> None:
    """Run all servers with all numbers of envs."""
    spec = PolicySpec(cameras=dict.fromkeys(CAMERAS, (args.images, args.images)) if args.images else {})
    report: dict[str, Any] = {"inference_ms": args.inference_ms, "images": args.images, "rounds": args.rounds}
    for server in args.servers:
        report[server] = {}
        for envs in args.envs:
            report[server][envs] = measure(server, envs, spec, args)
            print(server, envs, report[server][envs], file=sys.stderr)
    print(json.dumps(report, indent=2))


def measure(server: str, envs: int, spec: PolicySpec, args: Args) -> dict[str, float]:
    """Return the observations per second of one server, and the median time of a call of `act` in ms."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve_slowly, args=(server, args, spec, theirs), daemon=True)
    process.start()
    try:
        options = [] if server == "batched" else [*make_openpi_options(spec), *["max_in_flight=1"] * args.in_turn]
        policy = RemotePolicy(f"{ours.recv()}?{'&'.join(options)}")
        policy.reset([EpisodeSpec(env, env, "pick", "", "", "", env, "take the apple") for env in range(envs)])
        observations, times = make_observations(envs, spec), []
        for _ in range(WARM_UP + args.rounds):
            start = time.perf_counter()
            policy.act(observations)
            times.append(time.perf_counter() - start)
        policy.close()
    finally:
        process.terminate()
        process.join()
    measured = times[WARM_UP:]
    per_second = envs * len(measured) / sum(measured)
    return {"obs_per_s": round(per_second, 1), "act_ms": round(1000 * float(np.median(measured)), 2)}


def make_observations(envs: int, spec: PolicySpec) -> Observations:
    """Return observations of seeded noise."""
    rng = np.random.default_rng(0)
    shapes = {name: (envs, height, width, 3) for name, (width, height) in spec.cameras.items()}
    images = {name: rng.integers(0, 256, shape, np.uint8) for name, shape in shapes.items()}
    robot = {name: rng.normal(size=(envs, size)).astype(np.float32) for name, size in SIZES.items()}
    return Observations(np.arange(envs), ["take the apple"] * envs, None, images, {}, robot, None)


def make_openpi_options(spec: PolicySpec) -> list[str]:
    """Return the options of an address that a plain openpi server needs."""
    cameras = ",".join(f"{name}:{width}x{height}" for name, (width, height) in spec.cameras.items())
    return [f"cameras={cameras}"] if cameras else []


def serve_slowly(server: str, args: Args, spec: PolicySpec, pipe: Connection) -> None:
    """Serve until the process is terminated."""
    seconds = args.inference_ms / 1000
    if server == "batched":
        PolicyServer(SlowPolicy(seconds, spec), port=0, **({"max_batch": 1} if args.in_turn else {})).run(pipe.send)
    else:
        asyncio.run(serve_openpi(seconds, pipe, parallel=server == "parallel"))


async def serve_openpi(seconds: float, pipe: Connection, *, parallel: bool) -> None:
    """Serve zeros by openpi's protocol."""
    answer = encode_message({"actions": np.zeros(CHUNK)})

    async def talk(client: ServerConnection) -> None:
        await client.send(encode_message({}))
        async for _ in client:
            if parallel:
                await asyncio.sleep(seconds)
            else:
                time.sleep(seconds)
            await client.send(answer)

    async with serve(talk, "127.0.0.1", 0, compression=None, max_size=None) as running:
        pipe.send(f"ws://127.0.0.1:{next(iter(running.sockets)).getsockname()[1]}")
        await running.serve_forever()


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
