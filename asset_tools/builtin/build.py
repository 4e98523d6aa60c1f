"""Build the builtin pack from its formulas."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from tqdm import tqdm

from asset_tools.build import FurnitureSource, ObjectSource, build_furniture, build_object, new_pack
from asset_tools.builtin import furniture
from asset_tools.builtin.objects import SPECS
from asset_tools.visual import write_glb
from robocas_ms3.assets.manifest import FurnitureAsset, ObjectAsset
from robocas_ms3.assets.pack import VISUAL, sha256
from robocas_ms3.paths import builtin_packs_dir

NAME = "builtin"
DESCRIPTION = "Everyday objects, a table, a basket and a room, made of formulas"

MAKERS = {"table": furniture.table, "basket": furniture.basket, "room": furniture.room}


def main(out: Path | None = None, jobs: int = 2, ids: list[str] | None = None) -> Path:
    """Build the pack; it appears when everything in it is done. The same code gives the same files.

    Args:
        out: its folder, by default the one that travels with the package.
        jobs: processes.
        ids: only these assets; none: all.

    Returns:
        The pack's folder.

    Raises:
        AssetError: an asset can't be built.
    """
    folder = builtin_packs_dir() / NAME if out is None else Path(out)
    wanted = ids or [*MAKERS, *(spec.id for spec in SPECS)]
    with new_pack(folder, name=NAME, description=DESCRIPTION) as pack:
        for asset in _built(wanted, pack.folder, jobs):
            pack.add(asset)
    return folder


def build_asset(asset_id: str, parent: Path) -> ObjectAsset | FurnitureAsset:
    """Build one asset into ``parent / asset_id``.

    Raises:
        KeyError: there is no such builtin asset.
        AssetError: it can't be built.
    """
    folder = parent / asset_id
    if asset_id in MAKERS:
        piece = MAKERS[asset_id]()
        center, inertia = piece.mass_properties() if piece.mass else ((0.0, 0.0, 0.0), None)
        source = FurnitureSource(
            id=piece.id,
            name=piece.name,
            category=piece.category,
            mesh=piece.textured(),
            pieces=piece.pieces,
            mass=piece.mass,
            center_of_mass=_triple(center),
            inertia=None if inertia is None else _triple(inertia),
            origin_height=piece.origin_height,
            surfaces=piece.surfaces,
            inner=piece.inner,
        )
        return build_furniture(source, folder)
    spec = {spec.id: spec for spec in SPECS}[asset_id]
    shape, mesh = spec.build()
    source = ObjectSource(
        id=spec.id,
        name=spec.name,
        category=spec.category,
        mesh=mesh,
        closed=shape.closed(),
        mass=spec.mass,
        pieces=list(shape.pieces) or None,
    )
    asset = build_object(source, folder)
    # These meshes are light and centred already, with normals of their own: they need no other display mesh.
    write_glb(mesh, folder / VISUAL)
    return asset.model_copy(update={"files": {**asset.files, VISUAL: sha256(folder / VISUAL)}})


def _built(wanted: list[str], folder: Path, jobs: int):
    """Yield the assets as they get done, with a progress bar."""
    if jobs <= 1:
        for asset_id in tqdm(wanted, desc=NAME):
            yield build_asset(asset_id, folder)
        return
    # Physics and rendering libraries don't survive a fork.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        tasks = [pool.submit(build_asset, asset_id, folder) for asset_id in wanted]
        for task in tqdm(as_completed(tasks), total=len(tasks), desc=NAME):
            yield task.result()


def _triple(values) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 9) for value in values)
    return x, y, z
