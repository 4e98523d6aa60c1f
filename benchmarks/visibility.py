"""Measure the time and the error of visible fractions (p_vis) at several resolutions; print JSON.

python benchmarks/visibility.py [--heaps 5] [--pack builtin]

The scenes are heaps of the task search. Visible fractions of all objects are computed on one core. JSON keys:
  heaps, objects     number of heaps, and of objects per heap
  objects_below_0.9  fraction of objects with a visible fraction below 0.9
  fast, full         results for the meshes of this level of detail:
    triangles                    mean number of triangles per heap
    first_view_ms                CPU time of the first view in ms, which also builds the search trees of the meshes
    view_ms                      image size in pixels -> median CPU time per view in ms
    worst_difference_to_finest   image size -> largest difference of a visible fraction from that at 512 pixels
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro

from robocas_ms3.assets.pack import VisualLevel, load_pack
from robocas_ms3.core.poses import transform_points
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array
from robocas_ms3.scenes.sample import sample_layout
from robocas_ms3.scenes.visibility import MeshScene, load_visual_mesh, top_down_camera

SIZES = (512, 256, 128, 64)


@dataclass
class Args:
    heaps: int = 5
    """Number of heaps, one per seed."""
    pack: str = "builtin"
    """Object pack."""
    config: str = "search_table_stacked"
    """Task configuration."""
    repeats: int = 10
    """Number of views per heap and image size."""


def measure_milliseconds(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        work()
        times.append(1000 * (time.thread_time() - start))
    return float(np.median(times))


def main(args: Args) -> None:
    model = SceneModel.load(load_task_config(args.config), load_pack(args.pack), load_pack("builtin"))
    region = model.region
    middle = np.append(np.add(region.min_xy, region.max_xy) / 2, region.z)
    center = transform_points(model.support_pose, middle[None])[0]
    layouts = [sample_layout(model, seed, seed) for seed in range(args.heaps)]
    levels: tuple[VisualLevel, ...] = ("fast", "full")
    report: dict[str, object] = {"heaps": args.heaps, "objects": len(layouts[0].object_ids)}
    for level in levels:
        first, spent = [], {size: [] for size in SIZES}
        shares: dict[int, list[Array]] = {size: [] for size in SIZES}
        triangles = []
        for layout in layouts:
            meshes = [load_visual_mesh(model.object_pack.objects[i], level).copy() for i in layout.object_ids]
            triangles.append(sum(len(mesh.faces) for mesh in meshes))
            scenery = MeshScene(meshes, layout.object_poses)
            for size in SIZES:
                camera = top_down_camera(center[:2], center[2], size=size)
                if size == SIZES[0]:
                    first.append(measure_milliseconds(lambda: scenery.visible_fractions(camera), 1))  # noqa: B023
                spent[size].append(measure_milliseconds(lambda: scenery.visible_fractions(camera), args.repeats))  # noqa: B023
                shares[size].append(scenery.visible_fractions(camera))
        finest = np.concatenate(shares[SIZES[0]])
        report[level] = {
            "triangles": round(float(np.mean(triangles))),
            "first_view_ms": round(float(np.median(first)), 1),
            "view_ms": {size: round(float(np.median(spent[size])), 1) for size in SIZES},
            "worst_difference_to_finest": {
                size: round(float(np.nanmax(np.abs(np.concatenate(shares[size]) - finest))), 3) for size in SIZES[1:]
            },
        }
        if level == levels[0]:
            report["objects_below_0.9"] = round(float((finest < 0.9).mean()), 2)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
