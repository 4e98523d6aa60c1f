"""From a raw scan to what assets are made of: a textured mesh and a solid, in metres, z up, every mend logged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import trimesh

from asset_tools.level import level_base
from asset_tools.repair import close
from asset_tools.scan import METRES, PLAUSIBLE, Unit, Up, find_mesh, guess_unit, guess_up, load_scan, upright
from robocas_ms3.errors import AssetError

NAMES = {"cm": "centimetres", "mm": "millimetres", "inch": "inches"}


@dataclass(frozen=True)
class PreparedScan:
    """A scan, ready for hulls and grasps.

    Attributes:
        mesh: to look at; textured, metres, z up, faces outwards.
        closed: watertight, of the same body in the same frame.
        up: axis of the file that points up.
        unit: of the file.
        repairs: what had to be mended, in words.
    """

    mesh: trimesh.Trimesh
    closed: trimesh.Trimesh
    up: Up
    unit: Unit
    repairs: tuple[str, ...]


def prepare(path: Path, *, up: Up | None = None, unit: Unit | None = None) -> PreparedScan:
    """Read a scan and mend it: files, faces, holes, axis, unit, base.

    Args:
        path: of the mesh, or of a folder with one.
        up: axis of the file that points up; none: guessed.
        unit: of the file; none: guessed.

    Raises:
        AssetError: it can't be read or closed, or is of no size that can be picked up.
    """
    path = find_mesh(path)
    repairs: list[str] = []
    scan = load_scan(path, repairs)
    solid = close(scan)
    repairs += solid.repairs
    repairs += _about_colours(solid.scan)
    up = up or guess_up(solid.mesh, path.suffix)
    if up != "z":
        repairs.append(f"turned {up} up")
    longest = float(solid.mesh.extents.max())
    unit = unit or guess_unit([longest])
    if not PLAUSIBLE[0] <= longest * METRES[unit] <= PLAUSIBLE[1]:
        raise AssetError(
            "the scan is of no size that can be picked up",
            where=path,
            expected=f"{PLAUSIBLE[0]} to {PLAUSIBLE[1]} m for the longest side",
            found=f"{longest * METRES[unit]:g} m, taking its {longest:g} for {NAMES.get(unit, 'metres')}",
            fix="Pass --units.",
        )
    if unit != "m":
        repairs.append(f"scaled from {NAMES[unit]}")
    mesh, closed = (upright(part, up).apply_scale(METRES[unit]) for part in (solid.scan, solid.mesh))
    mesh, closed = level_base(mesh, closed, repairs)
    return PreparedScan(mesh, closed, up, unit, tuple(repairs))


def _about_colours(mesh: trimesh.Trimesh) -> list[str]:
    """What becomes of colours that are no texture."""
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        return ["baked the vertices' colours into a texture"]
    if visual.kind == "face":
        return ["baked the faces' colours into a texture"]
    image = getattr(getattr(visual, "material", None), "image", None)
    if image is not None and getattr(visual, "uv", None) is None:
        return ["left out a texture without coordinates"]
    return [] if visual.kind == "texture" else ["has no colours"]
