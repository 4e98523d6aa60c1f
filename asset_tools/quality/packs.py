"""Measure the assets of a whole pack anew, in parallel; what is asked of its furniture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import NoReturn

from asset_tools.quality.furniture import measure_furniture
from asset_tools.quality.measure import HULL_VERTICES, Violation, measure_again
from robocas_ms3.assets.manifest import FurnitureQuality, ObjectQuality
from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject, Pack
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

Quality = ObjectQuality | FurnitureQuality


def measure_pack(pack: Pack, processes: int = 1) -> Iterator[tuple[str, Quality]]:
    """Yield the id and the quality of each asset of a pack, objects first, in the pack's order.

    Raises:
        AssetError: the process that measured one died.
    """
    assets = [*pack.objects.values(), *pack.furniture.values()]
    workers = processes if min(processes, len(assets)) > 1 else 0
    with WorkerPool(partial(FunctionWorker, _measure), workers, on_crash=_raise_crash) as pool:
        yield from pool.map(assets)


FURNITURE_HEADER = ("furniture", "hulls", "vertices", "joints that work %", "surfaces that hold %")


def furniture_rows(qualities: Mapping[str, FurnitureQuality]) -> list[tuple[str, ...]]:
    """The table: a row of text for each piece of furniture, as `FURNITURE_HEADER` names it."""

    def share(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:.0f}"

    return [
        (name, str(q.hull_count), str(q.hull_vertices), share(q.joints_open), share(q.surfaces_hold))
        for name, q in qualities.items()
    ]


def check_furniture(qualities: Mapping[str, FurnitureQuality]) -> list[Violation]:
    """Say which pieces of furniture have joints that stick, surfaces that don't hold, or hulls too fine for a GPU."""
    found = []
    for name, quality in qualities.items():
        for what, share in (("joints that work", quality.joints_open), ("surfaces that hold", quality.surfaces_hold)):
            if share is not None and share < 1:
                found.append(Violation(name, what, "100%", f"{share:.0%}"))
        if quality.hull_vertices > HULL_VERTICES:
            found.append(Violation(name, "vertices of a hull", f"<= {HULL_VERTICES}", str(quality.hull_vertices)))
    return found


def _measure(asset: LoadedObject | LoadedFurniture) -> tuple[str, Quality]:
    return asset.asset.id, measure_again(asset) if isinstance(asset, LoadedObject) else measure_furniture(asset)


def _raise_crash(asset: LoadedObject | LoadedFurniture, why: str) -> NoReturn:
    fix = "Is memory short? Use fewer --jobs."
    raise AssetError("the process that measured it died", where=asset.asset.id, found=why, fix=fix)
