"""Measure CPU time and disk space of the images of decisions; print JSON.

python benchmarks/candidate_images.py demos/search/candidates.h5 [--sizes 640 480 320 240]

All cameras are rendered with depth, in this process. JSON keys:
  decisions, seeds     number of decisions and seeds
  cameras              names of the cameras
  state                bytes per decision of candidates.h5: state, candidates and outcomes
  W x H                results of an image size
    scene ms           CPU time per seed to build its scene
    cpu ms             CPU time per decision to render all cameras and to encode the images
    rgb, depth         bytes per decision
    MB per 1000        MB per 1000 decisions, RGB and depth
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.datasets import ImageOptions
from robocas_ms3.datasets.candidate_images.render import iter_seeds, make_recording, render_loaded
from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer
from robocas_ms3.demos.candidates.candidates_file import CandidateFile


@dataclass
class Benchmark:
    candidates: Annotated[Path, tyro.conf.Positional]
    """File candidates.h5."""
    sizes: tuple[int, ...] = (640, 480, 320, 240)
    """Widths and heights of the images in pixels, in turn."""
    seeds: int = 20
    """Number of seeds to render."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    use_one_torch_thread()
    file = CandidateFile(cfg.candidates)
    seeds = list(iter_seeds(file))[: cfg.seeds]
    result: dict[str, Any] = {
        "decisions": sum(last - first for first, last in seeds),
        "seeds": len(seeds),
        "cameras": [camera.name for camera in file.recorded_env.cameras()],
        "state": round(cfg.candidates.stat().st_size / len(file)),
    }
    for width, height in zip(cfg.sizes[::2], cfg.sizes[1::2], strict=True):
        result[f"{width} x {height}"] = measure(file, seeds, (width, height))
    print(json.dumps(result, indent=2))


def measure(file: CandidateFile, seeds: Sequence[tuple[int, int]], size: tuple[int, int]) -> dict[str, float]:
    """Render the decisions of these seeds; return CPU times in ms and sizes in bytes."""
    options = ImageOptions(size=size).select_cameras([camera.name for camera in file.recorded_env.cameras()], "cameras")
    scene = images = 0.0
    bytes_of = dict.fromkeys(options.kinds, 0)
    with closing(EnvRenderer(file.recorded_env, "pd_joint_pos", options)) as renderer:
        for rows in seeds:
            recording = make_recording(file, rows)
            start = time.process_time()
            renderer.load_scene(recording)
            middle = time.process_time()
            found = render_loaded(renderer, recording, options)
            scene, images = scene + middle - start, images + time.process_time() - middle
            for camera in found.values():
                for kind in bytes_of:
                    bytes_of[kind] += sum(map(len, getattr(camera, kind)))
    count = sum(last - first for first, last in seeds)
    return {
        "scene ms": round(1000 * scene / len(seeds), 1),
        "cpu ms": round(1000 * images / count, 1),
        **{kind: round(total / count) for kind, total in bytes_of.items()},
        "MB per 1000": round(sum(bytes_of.values()) / count / 1000, 1),
    }


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
