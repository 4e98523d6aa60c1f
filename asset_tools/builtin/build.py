"""Build the assets of the builtin pack."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from asset_tools.build import build_furniture, build_object
from asset_tools.builtin.catalogue import load_builtin_products
from asset_tools.builtin.furniture import MAKERS
from asset_tools.pipeline import AssetJob, compute_content_hash
from asset_tools.sources import ObjectSource
from robocas_ms3.assets.manifest import FurnitureAsset, ObjectAsset
from robocas_ms3.core.errors import AssetError

NAME = "builtin"
DESCRIPTION = "Everyday objects, furniture and a room, made of formulas"
FORMULAS_HASH = "formulas.sha256"
"""File of the bundled pack; it contains the `compute_formulas_hash` of the code that built the pack."""


def compute_formulas_hash() -> str:
    """Return the SHA-256 of the Python and YAML files from which the bundled pack is built."""
    digest, here = hashlib.sha256(), Path(__file__).parent
    for path in sorted(path for path in here.rglob("*") if path.suffix in (".py", ".yaml")):
        digest.update(path.relative_to(here).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def make_builtin_jobs(ids: Sequence[str] = ()) -> list[AssetJob]:
    """Return one job per asset of the builtin pack.

    Args:
        ids: ids of the assets to build; empty: all.

    Raises:
        AssetError: an id is unknown.
    """
    known = [*MAKERS, *load_builtin_products()]
    unknown = sorted(set(ids) - set(known))
    if unknown:
        fix = "Run `robocas assets info builtin` for the ids."
        raise AssetError("unknown ids of builtin assets", found=", ".join(unknown), fix=fix, usage=True)
    content = compute_content_hash(packages=("builtin", "builtin/furniture", "builtin/products"))
    return [AssetJob(id_, partial(build_asset, id_), content) for id_ in ids or known]


def build_asset(asset_id: str, folder: Path) -> ObjectAsset | FurnitureAsset:
    """Write the files of a builtin asset to a folder and return the manifest entry of the asset.

    The result is deterministic.

    Raises:
        KeyError: the id is unknown.
        AssetError: the asset cannot be built.
    """
    if asset_id in MAKERS:
        return build_furniture(MAKERS[asset_id](), folder)
    product = load_builtin_products()[asset_id]
    shape, mesh = product.build()
    source = ObjectSource(
        id=product.id,
        name=product.name,
        category=product.category,
        mesh=mesh,
        closed=shape.make_closed_mesh(),
        mass=product.mass,
        graspnet_id=product.graspnet_id,
        pieces=list(shape.pieces) or None,
        hollow=product.hollow,
    )
    return build_object(source, folder)
