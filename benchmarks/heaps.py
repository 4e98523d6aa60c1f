"""Measure the height of heaps, the visible fractions of objects, and the time to make a heap; print JSON.

python benchmarks/heaps.py --seeds 50

A visible fraction (p_vis) is the fraction of an object that is seen from above. JSON keys:
  config, pack            task configuration and object pack
  heaps                   number of heaps
  failures                seeds without a layout, with the reason
  height_m                5th, 50th and 95th percentile of the height of a heap in m
  objects_p_vis_below     limit -> fraction of all objects whose visible fraction is below the limit
  target_p_vis            5th, 50th and 95th percentile of the visible fraction of the target
  targets_p_vis_below     limit -> fraction of targets whose visible fraction is below the limit
  cpu_seconds             5th, 50th and 95th percentile of the CPU time per heap in seconds
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass

import numpy as np
import tyro

from robocas_ms3 import LayoutError
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.poses import transform_points
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout


@dataclass
class Benchmark:
    config: str = "search_table_stacked"
    """Task configuration."""
    pack: str = "builtin"
    """Object pack."""
    seeds: int = 50
    """Number of seeds, from 0 on."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    pack = load_pack(cfg.pack)
    model = SceneModel.load(load_task_config(cfg.config), pack, load_pack("builtin"))
    support = transform_points(model.support_pose, np.array([[0, 0, model.region.z]]))[0, 2]
    for asset in pack.objects.values():  # read once per process; not part of the time of a layout
        _ = asset.hulls, asset.annotations, asset.surface_points()
    heights, shares, targets, seconds, failures = [], [], [], [], []
    for seed in range(cfg.seeds):
        start = time.process_time()
        try:
            layout = sample_layout(model, seed, seed)
        except LayoutError as error:
            failures.append(f"{seed}: {error}")
            continue
        seconds.append(time.process_time() - start)
        assets = [pack.objects[i] for i in layout.object_ids]
        tops = [
            transform_points(p, np.concatenate(a.hulls))[:, 2].max()
            for a, p in zip(assets, layout.object_poses, strict=True)
        ]
        heights.append(max(tops) - support)
        shares.append(layout.visible_fractions)
        targets.append(layout.visible_fractions[layout.target])
    visible, target = np.concatenate(shares), np.array(targets)
    print(
        json.dumps(
            {
                "config": cfg.config,
                "pack": cfg.pack,
                "heaps": len(heights),
                "failures": failures,
                "height_m": _spread(heights),
                "objects_p_vis_below": {str(limit): _share(visible < limit) for limit in (0.9, 0.8, 0.5, 0.1)},
                "target_p_vis": _spread(targets),
                "targets_p_vis_below": {str(limit): _share(target < limit) for limit in (0.8, 0.5, 0.1)},
                "cpu_seconds": _spread(seconds),
            },
            indent=2,
        )
    )


def _spread(values: list[float]) -> dict[str, float]:
    return {f"p{q}": round(float(np.percentile(values, q)), 3) for q in (5, 50, 95)}


def _share(mask: np.ndarray) -> float:
    return round(float(np.mean(mask)), 3)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
