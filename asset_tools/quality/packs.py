"""Measure all assets of a pack in parallel, and check the requirements for furniture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import NoReturn

from asset_tools.quality.furniture import measure_furniture
from asset_tools.quality.measure import HULL_VERTICES, Violation, measure_object_again
from robocas_ms3.assets.manifest import FurnitureQuality, ObjectQuality
from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject, Pack
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

Quality = ObjectQuality | FurnitureQuality


def measure_pack(pack: Pack, processes: int = 1) -> Iterator[tuple[str, Quality]]:
    """Measure all assets of a pack again; yield the id and the quality of each asset, objects first.

    Args:
        pack: the pack.
        processes: number of worker processes.

    Raises:
        AssetError: a process that measured an asset crashed.
    """
    assets = [*pack.objects.values(), *pack.furniture.values()]
    workers = processes if min(processes, len(assets)) > 1 else 0
    with WorkerPool(partial(FunctionWorker, _measure), workers, on_crash=_raise_crash) as pool:
        yield from pool.map(assets)


FURNITURE_HEADER = ("furniture", "hulls", "vertices", "working joints %", "stable surfaces %")


def make_furniture_rows(qualities: Mapping[str, FurnitureQuality]) -> list[tuple[str, ...]]:
    """Return one table row per piece of furniture with the columns of `FURNITURE_HEADER`.

    Args:
        qualities: id of the furniture -> quality.
    """

    def percent(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:.0f}"

    return [
        (name, str(q.hull_count), str(q.hull_vertices), percent(q.joints_open), percent(q.surfaces_hold))
        for name, q in qualities.items()
    ]


def check_furniture(qualities: Mapping[str, FurnitureQuality]) -> list[Violation]:
    """Return the requirements for joints, surfaces and hull sizes that furniture does not meet.

    Args:
        qualities: id of the furniture -> quality.
    """
    found = []
    for name, quality in qualities.items():
        for what, fraction in (
            ("working joints", quality.joints_open),
            ("stable surfaces", quality.surfaces_hold),
        ):
            if fraction is not None and fraction < 1:
                found.append(Violation(name, what, "100%", f"{fraction:.0%}"))
        if quality.hull_vertices > HULL_VERTICES:
            found.append(Violation(name, "vertices of a hull", f"<= {HULL_VERTICES}", str(quality.hull_vertices)))
    return found


def _measure(asset: LoadedObject | LoadedFurniture) -> tuple[str, Quality]:
    return asset.asset.id, measure_object_again(asset) if isinstance(asset, LoadedObject) else measure_furniture(asset)


def _raise_crash(asset: LoadedObject | LoadedFurniture, reason: str) -> NoReturn:
    fix = "If the memory is short, use fewer --jobs."
    raise AssetError("the process that measured the asset crashed", where=asset.asset.id, found=reason, fix=fix)
