"""Measure the time per episode and the peak memory of conversions to RoboCAS and LeRobot; print JSON.

python benchmarks/convert_memory.py demos/pick/trajectory.h5 --episodes 20 200 --size 64 48

Compare the peak memory of conversions with different numbers of episodes to see whether memory grows. If the trajectory
has fewer episodes, its recordings are repeated in a temporary file. Each conversion runs in a new process, whose peak
memory includes Python, torch, PhysX, the renderer and a scene. With a software renderer, full images take seconds per
episode; --size 64 48 or --stand-in gives a result in a minute. JSON keys:
  size, rate, jobs, stand_in      options of the benchmark
  conversions                     one entry per conversion:
    to, episodes, steps           format, number of episodes and of dataset steps
    seconds, seconds_per_episode  wall-clock time
    peak_mb                       peak memory of the process in MB
    peak_mb_after_episode         number of converted episodes -> peak memory until then in MB
    peak_mb_of_largest_child      peak memory of the largest child process in MB; with --jobs, a process that renders
"""

from __future__ import annotations

import json
import math
import multiprocessing
import resource
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import h5py
import numpy as np
import tyro

_MB = 1024 / 1e6  # Linux reports kilobytes
_SHOWN = (1, 5, 10, 20, 50, 100, 200, 500, 1000)


@dataclass
class Benchmark:
    trajectory: Annotated[Path, tyro.conf.Positional]
    """File F.h5, next to F.json."""
    episodes: tuple[int, ...] = (20, 200)
    """Numbers of episodes; each is converted to each format."""
    to: tuple[Literal["robocas", "lerobot"], ...] = ("robocas", "lerobot")
    """Formats."""
    size: tuple[int, int] | None = None
    """Width and height of the images in pixels. Default: those of the cameras."""
    rate: float = 5.0
    """Rate of the dataset in Hz."""
    jobs: int = 1
    """Number of processes that render."""
    stand_in: bool = False
    """Write grey ramps instead of rendered images; all other work is done."""


class StandIn:
    """Renderer stand-in that returns grey ramps."""

    def __init__(self, _env_info: dict[str, Any], _control_mode: str, image_options: Any) -> None:
        self.image_options = image_options
        width, height = image_options.size or (640, 480)
        ramp = np.add.outer(np.arange(height), np.arange(width))
        self.rgb, self.depth = np.repeat(ramp[..., None] % 256, 3, 2).astype(np.uint8), ramp.astype(np.uint16)

    def load_scene(self, recording: Any) -> None:
        """Build nothing."""

    def frames(self, _recording: Any, samples: np.ndarray) -> Iterator[Any]:
        """Yield frames with a moving ramp."""
        from robocas_ms3.datasets.sources.episode_source import StepImages

        for sample in samples:
            rgb = {name: np.roll(self.rgb, sample, 1) for name in self.image_options.cameras}
            depth = {name: np.roll(self.depth, sample, 1) for name in self.image_options.cameras}
            yield StepImages(rgb, depth)

    def cameras(self) -> dict[str, Any]:
        """Return cameras at one pose."""
        from robocas_ms3.robots.camera_models import CameraModel

        model = CameraModel(np.array([24.0, 24.0, 32.0, 24.0]), np.eye(4), "world", np.eye(4))
        return dict.fromkeys(self.image_options.cameras, model)

    def scene(self) -> dict[str, Any]:
        """Return no scene."""
        return {"task": None, "config": None, "layout": None, "objects": None}

    def close(self) -> None:
        """Close nothing."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    results = []
    for count in cfg.episodes:
        for to in cfg.to:
            with tempfile.TemporaryDirectory() as folder:
                trajectory = repeat_recordings(cfg.trajectory, count, Path(folder) / "trajectory.h5")
                # in a new process, because the peak memory of a process never decreases
                with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                    results.append(pool.submit(measure, cfg, trajectory, to, Path(folder) / "out").result())
    about = {"size": cfg.size, "rate": cfg.rate, "jobs": cfg.jobs, "stand_in": cfg.stand_in}
    print(json.dumps({**about, "conversions": results}, indent=2))


def repeat_recordings(source: Path, count: int, target: Path) -> Path:
    """Write a trajectory of `count` successful recordings; repeated recordings are slightly changed."""
    metadata = json.loads(source.with_suffix(".json").read_text(encoding="utf-8"))
    good = [episode for episode in metadata["episodes"] if episode["success"]]
    episodes = []
    with h5py.File(source) as old, h5py.File(target, "w") as new:
        for number in range(count):
            episode = good[number % len(good)]
            old.copy(f"traj_{episode['episode_id']}", new, f"traj_{number}")
            new[f"traj_{number}/actions"][0, 0] += 1e-5 * (
                number // len(good)
            )  # a recording with an equal hash would be converted only once
            episodes.append({**episode, "episode_id": number})
    target.with_suffix(".json").write_text(json.dumps({**metadata, "episodes": episodes}), encoding="utf-8")
    return target


def measure(cfg: Benchmark, trajectory: Path, to: str, out: Path) -> dict[str, Any]:
    """Run one conversion in this process, and return its measurements."""
    from robocas_ms3.datasets import ConversionSettings, convert

    peaks: list[int] = []
    common: dict[str, Any] = {
        "rate_hz": cfg.rate,
        "size": cfg.size,
        "jobs": cfg.jobs,
        "open_renderer": StandIn if cfg.stand_in else None,
        "episode_seconds": math.inf,  # without limits, one job runs in this process
        "memory_gb": math.inf,
    }

    def on_episode(_: Any) -> None:
        peaks.append(_peak(resource.RUSAGE_SELF))

    if to == "lerobot":
        from robocas_ms3.datasets import convert_lerobot

        done = convert_lerobot(ConversionSettings(trajectory, out, **common), on_episode=on_episode)
    else:
        done = convert(
            ConversionSettings(trajectory, out, embeddings=False, video=False, **common), on_episode=on_episode
        )
    count = len(done.episodes)
    return {
        "to": to,
        "episodes": count,
        "steps": sum(episode.steps for episode in done.episodes),
        "seconds": round(done.seconds, 1),
        "seconds_per_episode": round(done.seconds / count, 3),
        "peak_mb": _peak(resource.RUSAGE_SELF),
        "peak_mb_after_episode": {number: peaks[number - 1] for number in _SHOWN if number <= count},
        "peak_mb_of_largest_child": _peak(resource.RUSAGE_CHILDREN),  # with --jobs: a process that renders
    }


def _peak(whose: int) -> int:
    return round(resource.getrusage(whose).ru_maxrss * _MB)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
