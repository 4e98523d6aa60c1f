"""Prepare a raw scan: a textured mesh and a closed mesh in metres with z up, and repairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from asset_tools.readers.model import read_model
from asset_tools.readers.surface import MultiTextureMaterial
from asset_tools.repair import close_scan
from asset_tools.scan import METRES_PER_UNIT, PLAUSIBLE, Unit, Up, guess_common_unit, guess_up_axis, rotate_upright
from asset_tools.solids import mesh_to_solid, solid_to_mesh
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

PRESS_STEP = 0.00025  # m, step of the tried depths
DEEPEST, SHARE = 0.004, 0.04  # m, and fraction of the height; limits of the base
BROAD = 0.6  # minimum ratio of the reaches of base and outline; 0.45 for a ball
FEET, ROCKS = (
    0.0003,
    0.5,
)  # m of contact tolerance; the object rocks if less than this fraction of the base's reach is within it
FLAT = 0.8  # required fraction of the base's reach
UNIT_NAMES = {"cm": "centimetres", "mm": "millimetres", "inch": "inches"}


@dataclass(frozen=True)
class PreparedScan:
    """A repaired scan, from which hulls and grasps can be computed.

    Attributes:
        mesh: visual mesh: textured, metres, z up, outward faces.
        closed: watertight mesh of the body, in the frame of ``mesh``.
        up: axis of the file that points up.
        unit: unit of the file.
        repairs: one line for each repair, replaced file and ignored feature. A line that starts with "warning:" is a
            change of the appearance.
    """

    mesh: trimesh.Trimesh
    closed: trimesh.Trimesh
    up: Up
    unit: Unit
    repairs: tuple[str, ...]


def prepare_scan(
    path: Path | Sequence[Path], *, root: Path | None = None, up: Up | None = None, unit: Unit | None = None
) -> PreparedScan:
    """Read a scan, repair faces, close holes, flatten the base, and convert it to metres with z up.

    Args:
        path: a mesh file, a folder of mesh files, or several mesh files, which may be versions of one mesh.
        root: the imported folder; files outside of this folder are not read. None: the folder of the scan.
        up: axis of the file that points up; None: guessed.
        unit: unit of the file; None: guessed.

    Raises:
        AssetError: the scan cannot be read or closed, or its size is not plausible for picking.
    """
    model = read_model(path if isinstance(path, Path) else list(path), root)
    repairs = list(model.notes)
    solid = close_scan(model.mesh)
    repairs += solid.repairs
    repairs += _about_colours(solid.scan)
    known = up or model.up
    up = known or guess_up_axis(solid.mesh)
    if up != "z":
        repairs.append(f"rotated {up} up" if known else f"rotated {up} up (guessed)")
    longest = float(solid.mesh.extents.max())
    unit = unit or guess_common_unit([longest])
    if not PLAUSIBLE[0] <= longest * METRES_PER_UNIT[unit] <= PLAUSIBLE[1]:
        raise AssetError(
            "implausible size of a scan",
            where=path if isinstance(path, Path) else path[0],
            expected=f"a longest side of {PLAUSIBLE[0]} to {PLAUSIBLE[1]} m",
            found=f"{longest * METRES_PER_UNIT[unit]:g} m ({longest:g} taken as {UNIT_NAMES.get(unit, 'metres')})",
            fix="Pass --units with the unit of the file.",
        )
    if unit != "m":
        repairs.append(f"scaled from {UNIT_NAMES[unit]}")
    mesh, closed = (rotate_upright(part, up).apply_scale(METRES_PER_UNIT[unit]) for part in (solid.scan, solid.mesh))
    mesh, closed = flatten_base(mesh, closed, repairs)
    return PreparedScan(mesh, closed, up, unit, tuple(repairs))


def _about_colours(mesh: trimesh.Trimesh) -> list[str]:
    """Return notes on the conversion of colours that are not a single texture."""
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        return ["baked colours into a texture"]
    if visual.kind == "texture":
        several = isinstance(visual.material, MultiTextureMaterial)
        return ["baked several textures and colours into one texture"] if several else []
    return ["has no colours"]


def flatten_base(
    mesh: trimesh.Trimesh, closed: trimesh.Trimesh, repairs: list[str]
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Flatten a broad base that bulges downwards, so that the object does not rock.

    Args:
        mesh: visual mesh, metres, z up.
        closed: watertight mesh of the body, in the frame of ``mesh``.
        repairs: list to which the function appends a note if it changes the meshes.

    Returns:
        Both meshes with a flat base; the input meshes if the base is already flat, or round as that of a ball.
    """
    center = np.asarray(closed.center_mass)
    low, height = float(closed.bounds[0, 2]), float(closed.extents[2])
    deepest = min(DEEPEST, SHARE * height)
    base = _reach(closed, low + deepest, center)
    outline = _edge_distance(np.asarray(closed.vertices)[:, :2], center)
    if base < BROAD * outline or _reach(closed, low + FEET, center) >= ROCKS * base:
        return mesh, closed
    for depth in np.arange(2 * PRESS_STEP, deepest, PRESS_STEP).tolist():
        if _reach(closed, low + depth, center) >= FLAT * base:
            vertices = np.array(mesh.vertices)
            vertices[:, 2] = np.maximum(vertices[:, 2], low + depth)
            pressed = mesh.copy()
            pressed.vertices = vertices
            repairs.append(f"pressed the base flat by {1e3 * depth:.2g} mm")
            solid: Any = mesh_to_solid(closed)  # a watertight mesh is a solid
            return pressed, solid_to_mesh(solid.trim_by_plane((0.0, 0.0, 1.0), low + depth))
    return mesh, closed


def _reach(closed: trimesh.Trimesh, height: float, center: Array) -> float:
    """Return the smallest distance in m from the centre of mass to the outline of a section.

    Args:
        closed: watertight mesh, metres, z up.
        height: z of the section, m.
        center: (3,) centre of mass.
    """
    section = closed.section([0, 0, 1], [0, 0, height])
    return 0.0 if section is None else _edge_distance(np.asarray(section.vertices)[:, :2], center)


def _edge_distance(flat: Array, center: Array) -> float:
    """Return the distance from xy of ``center`` to the nearest edge of the outline of points (N, 2).

    The distance is negative if the point is outside, and 0 if the points enclose no area.
    """
    try:
        return float((-(ConvexHull(flat).equations @ [*center[:2], 1.0])).min())
    except (QhullError, ValueError):
        return 0.0
