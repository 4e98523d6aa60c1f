"""Seconds an episode by part, and memory, of conversions to RoboCAS and to LeRobot. Prints JSON.

python benchmarks/convert_memory.py demos/pick/trajectory.h5 --episodes 20 200 --size 64 48
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

_MB = 1024 / 1e6  # Linux counts kilobytes
_SHOWN = (1, 5, 10, 20, 50, 100, 200, 500, 1000)


@dataclass
class Benchmark:
    """Convert so many episodes, and more: where the time goes, and whether memory grows with their number.

    Where the trajectory has fewer episodes, its recordings are repeated into a temporary larger one. Each conversion is
    a process of its own, and its peak that of the whole process: Python, torch, PhysX, the renderer and a scene are in
    it. Full images take seconds an episode where rendering is done in software; --size 64 48 shows as well whether
    memory grows, and so does --stand-in, in a minute.
    """

    trajectory: Annotated[Path, tyro.conf.Positional]
    """F.h5, with F.json beside it."""
    episodes: tuple[int, ...] = (20, 200)
    """How many episodes, one conversion to each format for each number."""
    to: tuple[Literal["robocas", "lerobot"], ...] = ("robocas", "lerobot")
    """Formats."""
    size: tuple[int, int] | None = None
    """Width and height of the images; default: the cameras' own."""
    rate: float = 5.0
    """Steps a second."""
    jobs: int = 1
    """Processes that render."""
    stand_in: bool = False
    """Do not render: grey ramps are the images. Everything else is done."""


class StandIn:
    """A ``FrameSource`` of grey ramps."""

    def __init__(self, _env_info: dict[str, Any], _control_mode: str, image_options: Any) -> None:
        self.image_options = image_options
        width, height = image_options.size or (640, 480)
        ramp = np.add.outer(np.arange(height), np.arange(width))
        self.rgb, self.depth = np.repeat(ramp[..., None] % 256, 3, 2).astype(np.uint8), ramp.astype(np.uint16)

    def load(self, recording: Any) -> None:
        """Nothing to build."""

    def frames(self, _recording: Any, samples: np.ndarray) -> Iterator[Any]:
        """A ramp that moves."""
        from robocas_ms3.datasets.sources.episode_source import StepImages

        for sample in samples:
            rgb = {name: np.roll(self.rgb, sample, 1) for name in self.image_options.cameras}
            depth = {name: np.roll(self.depth, sample, 1) for name in self.image_options.cameras}
            yield StepImages(rgb, depth)

    def cameras(self) -> dict[str, Any]:
        """All in one place."""
        from robocas_ms3.datasets.sources.episode_source import CameraModel

        model = CameraModel(np.array([24.0, 24.0, 32.0, 24.0]), np.eye(4), "world")
        return dict.fromkeys(self.image_options.cameras, model)

    def scene(self) -> dict[str, Any]:
        """Nothing is known."""
        return {"task": None, "config": None, "layout": None, "objects": None}

    def close(self) -> None:
        """Nothing is open."""


def main(cfg: Benchmark) -> None:
    """Run it."""
    results = []
    for count in cfg.episodes:
        for to in cfg.to:
            with tempfile.TemporaryDirectory() as folder:
                trajectory = repeated(cfg.trajectory, count, Path(folder) / "trajectory.h5")
                # A fresh process: a peak of before does not hide this one's.
                with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                    results.append(pool.submit(measure, cfg, trajectory, to, Path(folder) / "out").result())
    about = {"size": cfg.size, "rate": cfg.rate, "jobs": cfg.jobs, "stand_in": cfg.stand_in}
    print(json.dumps({**about, "conversions": results}, indent=2))


def repeated(source: Path, count: int, target: Path) -> Path:
    """A trajectory of so many successful recordings of another, which begin anew where they end, a little changed."""
    metadata = json.loads(source.with_suffix(".json").read_text(encoding="utf-8"))
    good = [episode for episode in metadata["episodes"] if episode["success"]]
    episodes = []
    with h5py.File(source) as old, h5py.File(target, "w") as new:
        for number in range(count):
            episode = good[number % len(good)]
            old.copy(f"traj_{episode['episode_id']}", new, f"traj_{number}")
            new[f"traj_{number}/actions"][0, 0] += 1e-5 * (number // len(good))  # a recording is converted once
            episodes.append({**episode, "episode_id": number})
    target.with_suffix(".json").write_text(json.dumps({**metadata, "episodes": episodes}), encoding="utf-8")
    return target


def measure(cfg: Benchmark, trajectory: Path, to: str, out: Path) -> dict[str, Any]:
    """One conversion, in the process that this is called in."""
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
        "seconds_an_episode": round(done.seconds / count, 3),
        "peak_mb": _peak(resource.RUSAGE_SELF),
        "peak_mb_after_episode": {number: peaks[number - 1] for number in _SHOWN if number <= count},
        "peak_mb_of_largest_child": _peak(resource.RUSAGE_CHILDREN),  # with --jobs a process that renders
    }


def _peak(whose: int) -> int:
    return round(resource.getrusage(whose).ru_maxrss * _MB)


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
