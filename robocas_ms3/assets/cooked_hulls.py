"""Check what PhysX makes of convex hulls, on a CPU and for a GPU.

PhysX "cooks" hulls: it leaves out detail of up to 0.7 mm, and for a GPU whatever goes beyond 64 vertices or 64 faces,
which can shrink a hull by millimetres without a warning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from sapien import physx
from scipy.spatial import ConvexHull

from robocas_ms3.assets.hulls import Array, find_box, read_hulls, slenderness
from robocas_ms3.assets.pack import HULLS
from robocas_ms3.assets.physics import cook
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

SHRINKAGE = 0.0015  # m that a hull may lose anywhere: PhysX merges vertices and faces within 0.7 mm each
OBLONG = 100  # slenderness from which on PhysX makes no hull for a GPU


@dataclass(frozen=True)
class CookedHull:
    """Result of cooking a hull.

    Attributes:
        lost: m, distance of its farthest vertex from the cooked hull; infinite: the engine made none.
        oblong: whether it is too slender for a GPU.
    """

    lost: float
    oblong: bool


@dataclass(frozen=True)
class HullViolation:
    """A hull that is smaller once cooked.

    Attributes:
        asset: its folder in the pack; of a moving part ``<furniture>/links/<link>``.
        hull: its number in the file, from 0 on.
        way: ``CPU`` or ``GPU``.
        cooked: the result.
    """

    asset: str
    hull: int
    way: str
    cooked: CookedHull

    def __str__(self) -> str:
        if not np.isfinite(self.cooked.lost):
            what = "can't be built"
        elif self.cooked.oblong:
            what = "is too slender"
        else:
            what = f"shrinks by {1e3 * self.cooked.lost:.1f} mm"
        return f"{self.asset}: hull {self.hull} {what} on a {self.way}"


def find_hull_violations(folder: Path) -> list[HullViolation]:
    """Cook all hulls in a pack's folder, but boxes, for CPU and GPU; return those that shrink or can't be built."""
    named: list[tuple[str, int, Array]] = []
    for path in sorted(folder.rglob(HULLS)):
        name = path.parent.relative_to(folder).as_posix()
        hulls = enumerate(read_hulls(path))
        named += [(name, number, hull.vertices) for number, hull in hulls if find_box(hull.vertices) is None]
    if not named:
        return []
    pieces = [vertices for _, _, vertices in named]

    def raise_crash(task: object, why: str) -> NoReturn:
        raise AssetError("the process that cooked its hulls died", where=folder, found=why, fix="Is memory short?")

    with WorkerPool(_as_a_gpu_does, 1, on_crash=raise_crash) as pool:
        on_gpu = pool.run(pieces)
    ways = {"GPU": on_gpu, "CPU": cook_hulls(pieces)}
    return [
        HullViolation(name, number, way, result)
        for way, results in ways.items()
        for (name, number, _), result in zip(named, results, strict=True)
        if result.lost > SHRINKAGE or (result.oblong and way == "GPU")
    ]


def cook_hulls(hulls: Sequence[Array]) -> list[CookedHull]:
    """Cook convex hulls of points (V, 3) with the engine's settings of this process."""
    material = physx.PhysxMaterial(0.5, 0.5, 0.0)
    results = []
    for vertices in hulls:
        try:
            shape = cook(vertices, material)
        except RuntimeError:
            results.append(CookedHull(np.inf, oblong=False))
            continue
        planes = ConvexHull(shape.vertices).equations
        lost = max(0.0, float((vertices @ planes[:, :3].T + planes[:, 3]).max()))
        results.append(CookedHull(lost, oblong=slenderness(vertices) >= OBLONG))
    return results


def _as_a_gpu_does() -> FunctionWorker[Sequence[Array], list[CookedHull]]:
    physx._enable_gpu()
    return FunctionWorker(cook_hulls)
