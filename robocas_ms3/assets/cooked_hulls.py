"""Check the convex hulls that PhysX builds ("cooks") for CPU and GPU.

PhysX omits details up to 0.7 mm, and limits hulls for a GPU to 64 vertices and 64 faces. This can shrink a hull by
millimetres without a warning.
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
from robocas_ms3.assets.physics import make_convex_shape
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

MAX_SHRINKAGE = 0.0015  # m; PhysX merges vertices and faces within 0.7 mm
MAX_SLENDERNESS = 100  # PhysX builds no hull for a GPU at or above this value


@dataclass(frozen=True)
class CookedHull:
    """Comparison of a convex hull with the hull that PhysX builds from its vertices.

    Attributes:
        shrinkage: greatest distance of a vertex outside of PhysX's hull, m; infinite if PhysX built no hull.
        too_slender: whether the hull is too slender for a GPU.
    """

    shrinkage: float
    too_slender: bool


@dataclass(frozen=True)
class HullViolation:
    """A hull that PhysX shrinks or cannot build.

    Attributes:
        asset: folder of the asset in the pack; ``<furniture>/links/<link>`` for a moving part.
        hull: index of the hull in the file.
        device: ``CPU`` or ``GPU``.
        cooked: comparison with PhysX's hull.
    """

    asset: str
    hull: int
    device: str
    cooked: CookedHull

    def __str__(self) -> str:
        if not np.isfinite(self.cooked.shrinkage):
            what = "cannot be built"
        elif self.cooked.too_slender:
            what = "is too slender"
        else:
            what = f"shrinks by {1e3 * self.cooked.shrinkage:.1f} mm"
        return f"{self.asset}: hull {self.hull} {what} on a {self.device}"


def find_hull_violations(folder: Path) -> list[HullViolation]:
    """Build each hull of a pack with PhysX for CPU and GPU; return those that shrink or cannot be built.

    Boxes are not built, because PhysX has an exact shape for them.

    Args:
        folder: the pack.
    """
    named: list[tuple[str, int, Array]] = []
    for path in sorted(folder.rglob(HULLS)):
        name = path.parent.relative_to(folder).as_posix()
        hulls = enumerate(read_hulls(path))
        named += [(name, number, hull.vertices) for number, hull in hulls if find_box(hull.vertices) is None]
    if not named:
        return []
    pieces = [vertices for _, _, vertices in named]

    def raise_crash(task: object, reason: str) -> NoReturn:
        raise AssetError(
            "the process that checked the convex hulls crashed",
            where=folder,
            found=reason,
            fix="Free some memory and try again.",
        )

    with WorkerPool(_make_gpu_worker, 1, on_crash=raise_crash) as pool:
        on_gpu = pool.run(pieces)
    by_device = {"GPU": on_gpu, "CPU": cook_hulls(pieces)}
    return [
        HullViolation(name, number, device, result)
        for device, results in by_device.items()
        for (name, number, _), result in zip(named, results, strict=True)
        if result.shrinkage > MAX_SHRINKAGE or (result.too_slender and device == "GPU")
    ]


def cook_hulls(hulls: Sequence[Array]) -> list[CookedHull]:
    """Build convex hulls of vertices (V, 3) with PhysX, with the engine settings of this process."""
    material = physx.PhysxMaterial(0.5, 0.5, 0.0)
    results = []
    for vertices in hulls:
        try:
            shape = make_convex_shape(vertices, material)
        except RuntimeError:
            results.append(CookedHull(np.inf, too_slender=False))
            continue
        planes = ConvexHull(shape.vertices).equations
        shrinkage = max(0.0, float((vertices @ planes[:, :3].T + planes[:, 3]).max()))
        results.append(CookedHull(shrinkage, too_slender=slenderness(vertices) >= MAX_SLENDERNESS))
    return results


def _make_gpu_worker() -> FunctionWorker[Sequence[Array], list[CookedHull]]:
    physx._enable_gpu()
    return FunctionWorker(cook_hulls)
