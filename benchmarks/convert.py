"""Measure the CPU time of conversions, and compare it with rendering alone; print JSON.

python benchmarks/convert.py [demos/pick/trajectory.h5] [--episodes 2] [--turns 3] [--jobs 2]

The bare loop sets each state, renders the three cameras and reads the raw images of the shader, as all conversions do.
A conversion also builds scenes, computes all features, and writes files and previews. The cases alternate with the bare
loop on the same recordings. CPU time is the sum over this process and its children. JSON keys:
  cores, load, size    number of cores, load average, size of the images in pixels
  steps                number of dataset steps of all recordings
  bare, depth; bare    results of the bare loop with and without depth
  png, depth; png; lerobot, depth; lerobot   results of conversions to RoboCAS and LeRobot, with and without depth
    cpu ms per step    median over the rounds of the CPU time per dataset step in ms
    cpu s, wall s      CPU and wall-clock time of each round in seconds
    / bare             CPU time as a factor of the bare loop
  jobs                 only with --jobs: speedup (by wall-clock time) and wall s (number of processes -> times)
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import torch
import tyro
from convert_memory import repeat_recordings

from robocas_ms3.datasets import ConversionSettings, ImageOptions, convert, convert_lerobot
from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer
from robocas_ms3.demos import TrajectoryFile
from robocas_ms3.demos.recordings.motion import sample_states, sample_stride

ROOT = Path(__file__).resolve().parents[1]
CASES = {  # name -> format, whether with depth
    "png, depth": ("robocas", True),
    "png": ("robocas", False),
    "lerobot, depth": ("lerobot", True),
    "lerobot": ("lerobot", False),
}
TEXTURES = {True: ("Color", "PositionSegmentation"), False: ("Color",)}  # of the shader "minimal"


@dataclass
class Benchmark:
    trajectory: Annotated[Path | None, tyro.conf.Positional] = None
    """File F.h5, next to F.json. Default: pick demonstrations, which are generated first."""
    episodes: int = 2
    """Number of successful recordings; a file with fewer is repeated."""
    turns: int = 3
    """Number of rounds of the bare loop and of each case."""
    cases: tuple[str, ...] = tuple(CASES)
    """Conversions to measure."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the images in pixels."""
    rate: float = 5.0
    """Rate of the dataset in Hz."""
    jobs: int = 0
    """Number of processes to compare with one process by wall-clock time. 0: no comparison."""
    jobs_episodes: int = 8
    """Number of recordings for that comparison; starting a process takes seconds."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        source = cfg.trajectory or generate_demonstrations(work / "demos", cfg.episodes)
        trajectory = repeat_recordings(source, cfg.episodes, work / "trajectory.h5")
        report: dict[str, Any] = {"cores": os.cpu_count(), "load": os.getloadavg()[1], "size": cfg.size}
        report |= measure_cases(cfg, trajectory, work)
        if cfg.jobs > 1:
            more = repeat_recordings(source, cfg.jobs_episodes, work / "more.h5")
            walls: dict[int, list[float]] = {1: [], cfg.jobs: []}
            for _ in range(cfg.turns):
                for jobs, spent in walls.items():
                    spent.append(measure_seconds(partial(convert_one, cfg, more, work, "robocas", True, jobs))[1])
            faster = median(walls[1]) / median(walls[cfg.jobs])
            report["jobs"] = {"speedup": round(faster, 2), "wall s": {n: round_seconds(w) for n, w in walls.items()}}
    print(json.dumps(report, indent=2))


def measure_cases(cfg: Benchmark, trajectory: Path, work: Path) -> dict[str, Any]:
    """Return the CPU and wall-clock times of the bare loop and the cases; each runs once per round."""
    bare: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    cases: dict[str, list[tuple[float, float]]] = {name: [] for name in cfg.cases}
    with TrajectoryFile(trajectory) as file:
        steps = sum(
            len(sample_states(file.read_recording(i).control_steps, _stride(cfg, file))) for i in range(cfg.episodes)
        )
        with closing(EnvRenderer(file.env, file.read_recording(0).control_mode, ImageOptions(size=cfg.size))) as source:
            for _ in range(cfg.turns):
                for depth, spent in bare.items():
                    spent.append(render_alone(cfg, file, source, TEXTURES[depth]))
                for name, spent in cases.items():
                    to, depth = CASES[name]
                    spent.append(measure_seconds(partial(convert_one, cfg, trajectory, work, to, depth)))

    def summarise(spent: list[tuple[float, float]]) -> dict[str, Any]:
        cpu, wall = zip(*spent, strict=True)
        return {
            "cpu ms per step": round(1000 * median(cpu) / steps, 1),
            "cpu s": round_seconds(cpu),
            "wall s": round_seconds(wall),
        }

    per_step = {depth: median(cpu for cpu, _ in spent) for depth, spent in bare.items()}
    return {
        "steps": steps,
        "bare, depth": summarise(bare[True]),
        "bare": summarise(bare[False]),
        **{
            name: {
                "/ bare": round(median(cpu for cpu, _ in spent) / per_step[CASES[name][1]], 2),
                **summarise(spent),
            }
            for name, spent in cases.items()
        },
    }


def render_alone(
    cfg: Benchmark, file: TrajectoryFile, source: EnvRenderer, textures: tuple[str, ...]
) -> tuple[float, float]:
    """Return the CPU and wall-clock seconds of rendering the recordings, without the time of building scenes."""
    total = (0.0, 0.0)
    env: Any = source.env.unwrapped
    for index in range(cfg.episodes):
        recording = file.read_recording(index)
        source.load_scene(recording)
        scene = env.scene.sub_scenes[0]
        cameras = [sensor.camera._render_cameras[0] for sensor in env._sensors.values()]
        samples = sample_states(recording.control_steps, _stride(cfg, file))
        states = [
            {kind: {name: torch.from_numpy(one) for name, one in arrays.items()} for kind, arrays in state.items()}
            for state in (recording.state(int(sample)) for sample in samples)
        ]

        def loop(states=states, cameras=cameras, scene=scene) -> None:
            for state in states:
                env.set_state_dict(state)
                scene.update_render()
                for camera in cameras:
                    camera.take_picture()
                for camera in cameras:
                    for texture in textures:
                        camera.get_picture(texture)

        spent = measure_seconds(loop)
        total = (total[0] + spent[0], total[1] + spent[1])
    return total


def convert_one(cfg: Benchmark, trajectory: Path, work: Path, to: str, depth: bool, jobs: int = 1) -> None:
    """Convert the recordings, with previews."""
    common: dict[str, Any] = {"rate_hz": cfg.rate, "size": cfg.size, "depth": depth, "jobs": jobs}
    common |= {"episode_seconds": math.inf, "memory_gb": math.inf}  # without limits, one job runs in this process
    with tempfile.TemporaryDirectory(dir=work) as out:
        if to == "lerobot":
            convert_lerobot(ConversionSettings(trajectory, Path(out) / "out", **common))
            return
        convert(ConversionSettings(trajectory, Path(out) / "out", embeddings=False, **common))


def generate_demonstrations(out: Path, episodes: int) -> Path:
    """Generate pick demonstrations from seed 0."""
    command = [sys.executable, ROOT / "robocas_cli.py", "generate", "pick", "-n", str(episodes), "--out", out]
    subprocess.run(command, check=True, stdout=sys.stderr)
    return out / "trajectory.h5"


def measure_seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Return the CPU and wall-clock seconds of a call."""
    before, start = read_cpu_seconds(), time.perf_counter()
    call()
    return read_cpu_seconds() - before, time.perf_counter() - start


def read_cpu_seconds() -> float:
    """Return the CPU seconds of this process and its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def round_seconds(seconds: Any) -> list[float]:
    return [round(one, 2) for one in seconds]


def _stride(cfg: Benchmark, file: TrajectoryFile) -> int:
    return sample_stride(file.control_freq, cfg.rate)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
