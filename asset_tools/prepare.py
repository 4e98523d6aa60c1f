"""From a raw scan to what assets are made of: a textured mesh and a solid, in metres, z up, every repair logged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import trimesh

from asset_tools.level import level_base
from asset_tools.reading.model import read_model
from asset_tools.reading.surface import Textures
from asset_tools.repair import close
from asset_tools.scan import METRES, PLAUSIBLE, Unit, Up, guess_unit, guess_up, upright
from robocas_ms3.core.errors import AssetError

NAMES = {"cm": "centimetres", "mm": "millimetres", "inch": "inches"}


@dataclass(frozen=True)
class PreparedScan:
    """A scan, ready for hulls and grasps.

    Attributes:
        mesh: to look at; textured, metres, z up, faces outwards.
        closed: watertight, of the same body in the same frame.
        up: axis of the file that points up.
        unit: of the file.
        repairs: what was repaired, substituted or left out, one line each; those that begin with "warning:" change how
            the object looks.
    """

    mesh: trimesh.Trimesh
    closed: trimesh.Trimesh
    up: Up
    unit: Unit
    repairs: tuple[str, ...]


def prepare(
    path: Path | Sequence[Path], *, root: Path | None = None, up: Up | None = None, unit: Unit | None = None
) -> PreparedScan:
    """Read a scan and repair it: files, faces, holes, axis, unit, base.

    Args:
        path: the mesh file, a folder with its files, or several files of which some are versions of others.
        root: the imported folder, outside of which nothing is read; None: the scan's own folder.
        up: axis of the file that points up; None: guessed.
        unit: of the file; None: guessed.

    Raises:
        AssetError: it can't be read or closed, or is of no size that can be picked up.
    """
    model = read_model(path if isinstance(path, Path) else list(path), root)
    repairs = list(model.notes)
    solid = close(model.mesh)
    repairs += solid.repairs
    repairs += _about_colours(solid.scan)
    known = up or model.up
    up = known or guess_up(solid.mesh)
    if up != "z":
        repairs.append(f"turned {up} up" if known else f"turned {up} up, a guess")
    longest = float(solid.mesh.extents.max())
    unit = unit or guess_unit([longest])
    if not PLAUSIBLE[0] <= longest * METRES[unit] <= PLAUSIBLE[1]:
        raise AssetError(
            "the scan is of no size that can be picked up",
            where=path if isinstance(path, Path) else path[0],
            expected=f"{PLAUSIBLE[0]} to {PLAUSIBLE[1]} m for the longest side",
            found=f"{longest * METRES[unit]:g} m, taking its {longest:g} for {NAMES.get(unit, 'metres')}",
            fix="Pass --units with the unit of the file.",
        )
    if unit != "m":
        repairs.append(f"scaled from {NAMES[unit]}")
    mesh, closed = (upright(part, up).apply_scale(METRES[unit]) for part in (solid.scan, solid.mesh))
    mesh, closed = level_base(mesh, closed, repairs)
    return PreparedScan(mesh, closed, up, unit, tuple(repairs))


def _about_colours(mesh: trimesh.Trimesh) -> list[str]:
    """Return what becomes of colours that are no single texture."""
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        return ["baked colours into a texture"]
    if visual.kind == "texture":
        several = isinstance(visual.material, Textures)
        return ["baked several textures and colours into one texture"] if several else []
    return ["has no colours"]
