"""The builtin pack: what is to be made of its formulas."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from asset_tools.build import build_furniture, build_object
from asset_tools.builtin.catalogue import products
from asset_tools.builtin.furniture import MAKERS
from asset_tools.pipeline import AssetJob, content_hash
from asset_tools.sources import ObjectSource
from robocas_ms3.assets.manifest import FurnitureAsset, ObjectAsset
from robocas_ms3.core.errors import AssetError

NAME = "builtin"
DESCRIPTION = "Everyday objects, furniture and a room, made of formulas"
FORMULAS_HASH = "formulas.sha256"
"""File of the shipped pack with the `formulas_hash` it was built from."""


def formulas_hash() -> str:
    """Return the SHA-256 of the code and tables of this package, which the shipped pack is built from."""
    digest, here = hashlib.sha256(), Path(__file__).parent
    for path in sorted(path for path in here.rglob("*") if path.suffix in (".py", ".yaml")):
        digest.update(path.relative_to(here).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def builtin_jobs(ids: Sequence[str] = ()) -> list[AssetJob]:
    """What is to be made.

    Args:
        ids: only these assets; none: all.

    Raises:
        AssetError: there is no such builtin asset.
    """
    known = [*MAKERS, *products()]
    unknown = sorted(set(ids) - set(known))
    if unknown:
        raise AssetError("no such builtin asset", expected=f"one of {', '.join(known)}", found=", ".join(unknown))
    content = content_hash(packages=("builtin", "builtin/furniture", "builtin/products"))
    return [AssetJob(id_, partial(build_asset, id_), content) for id_ in ids or known]


def build_asset(asset_id: str, folder: Path) -> ObjectAsset | FurnitureAsset:
    """Build one asset's files in a folder. The same code gives the same files.

    Raises:
        KeyError: there is no such builtin asset.
        AssetError: it can't be built.
    """
    if asset_id in MAKERS:
        return build_furniture(MAKERS[asset_id](), folder)
    product = products()[asset_id]
    shape, mesh = product.build()
    source = ObjectSource(
        id=product.id,
        name=product.name,
        category=product.category,
        mesh=mesh,
        closed=shape.closed(),
        mass=product.mass,
        graspnet_id=product.graspnet_id,
        pieces=list(shape.pieces) or None,
        hollow=product.hollow,
    )
    return build_object(source, folder)
