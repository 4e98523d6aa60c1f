"""Measure the seconds that each step of building an object takes, for builtin objects; print JSON.

python benchmarks/assets.py --ids banana drink large_elephant

JSON keys:
  objects   number of objects
  steps     per step, median_s and max_s: median and maximum over the objects of the wall-clock time in seconds. Steps:
            shape and texture, display meshes (both levels of detail), hulls, resting poses, grasps, quality (hull
            comparison, drop test and hold test)
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro

from asset_tools.build import write_visuals
from asset_tools.builtin.catalogue import load_builtin_products
from asset_tools.decompose import decompose_mesh
from asset_tools.grasps import sample_grasps
from asset_tools.inertia import compute_principal_inertia
from asset_tools.quality.drops import run_drop_test
from asset_tools.quality.grasp_hold import run_hold_test
from asset_tools.quality.hulls import measure_hull_quality
from asset_tools.resting_poses import find_resting_poses
from robocas_ms3.assets.physics import RigidBody


@dataclass
class Benchmark:
    ids: tuple[str, ...] = ()
    """Ids of the objects. Default: all 46."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    seconds: dict[str, dict[str, float]] = defaultdict(dict)
    for spec in load_builtin_products().values():
        if cfg.ids and spec.id not in cfg.ids:
            continue

        @contextmanager
        def timed(step: str, id_: str = spec.id) -> Iterator[None]:
            start = time.perf_counter()
            yield
            seconds[step][id_] = time.perf_counter() - start

        with timed("shape and texture"):
            shape, mesh = spec.build()
        closed = shape.make_closed_mesh()
        with timed("display meshes"), TemporaryDirectory() as folder:
            write_visuals(mesh, Path(folder))
        with timed("hulls"):
            hulls = list(shape.pieces) or decompose_mesh(closed).hulls
        center = np.asarray(closed.center_mass)
        inertia, axes = compute_principal_inertia(closed, spec.mass)
        solid = RigidBody(hulls, spec.mass, center, np.array(inertia), np.array(axes))
        with timed("resting poses"):
            rest = find_resting_poses(solid)
        with timed("grasps"):
            grasps = sample_grasps(closed, center, np.random.default_rng(0), count=800)
        with timed("quality"):
            measure_hull_quality(closed, hulls, hollow=spec.hollow)
            run_drop_test(solid, rest.poses)
            run_hold_test(solid, grasps.tcp_in_object[:20])
    steps = {
        step: {"median_s": round(float(np.median(list(v.values()))), 2), "max_s": round(max(v.values()), 2)}
        for step, v in seconds.items()
    }
    print(json.dumps({"objects": len(seconds["grasps"]), "steps": steps}, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
