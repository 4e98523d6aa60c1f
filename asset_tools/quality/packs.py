"""Measure the assets of a whole pack anew, in parallel."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from asset_tools.quality.furniture import measure_furniture
from asset_tools.quality.measure import remeasure
from robocas_ms3.assets.manifest import FurnitureQuality, ObjectQuality
from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject, Pack

Quality = ObjectQuality | FurnitureQuality


def remeasure_pack(pack: Pack, processes: int = 1) -> Iterator[tuple[str, Quality]]:
    """Yield the id and the quality of each asset of a pack, objects first, in the pack's order."""
    assets = {**pack.objects, **pack.furniture}
    if processes <= 1:
        yield from ((name, _measure(asset)) for name, asset in assets.items())
        return
    # physics engines don't survive a fork
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield from zip(assets, pool.map(_measure, assets.values()), strict=True)


def _measure(asset: LoadedObject | LoadedFurniture) -> Quality:
    return remeasure(asset) if isinstance(asset, LoadedObject) else measure_furniture(asset)
