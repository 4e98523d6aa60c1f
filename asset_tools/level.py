"""Flat bases: what stands in life but was scanned with a base that bulges can't stand on it; pressed flat, it can."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from asset_tools.solids import to_mesh, to_solid

Array = NDArray[np.float64]

STEP = 0.00025  # m: depths that are tried
DEEPEST, SHARE = 0.004, 0.04  # m, and share of the height, above which nothing belongs to the base
BROAD = 0.6  # reach of the base over that of the body's outline; a ball's reaches 0.45 there
FEET, ROCKS = 0.0003, 0.5  # m that contacts forgive; with less of the base's reach within it, it rocks
FLAT = 0.8  # of the base's reach that is wanted


def level_base(
    mesh: trimesh.Trimesh, closed: trimesh.Trimesh, repairs: list[str]
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Press the base flat where it bulges so that the thing rocks on it, though it is broad enough to stand on.

    Args:
        mesh: to look at; metres, z up.
        closed: watertight, the same body in the same frame.
        repairs: gets a line if something was done.

    Returns:
        both, as they were if there was nothing to do or the base is round.
    """
    center = np.asarray(closed.center_mass)
    low, height = float(closed.bounds[0, 2]), float(closed.extents[2])
    deepest = min(DEEPEST, SHARE * height)
    base = _reach(closed, low + deepest, center)
    outline = _edge_distance(np.asarray(closed.vertices)[:, :2], center)
    if base < BROAD * outline or _reach(closed, low + FEET, center) >= ROCKS * base:
        return mesh, closed
    for depth in np.arange(2 * STEP, deepest, STEP).tolist():
        if _reach(closed, low + depth, center) >= FLAT * base:
            vertices = np.array(mesh.vertices)
            vertices[:, 2] = np.maximum(vertices[:, 2], low + depth)
            pressed = mesh.copy()
            pressed.vertices = vertices
            repairs.append(f"pressed the base flat by {1e3 * depth:.2g} mm")
            solid: Any = to_solid(closed)  # what is watertight is one
            return pressed, to_mesh(solid.trim_by_plane((0.0, 0.0, 1.0), low + depth))
    return mesh, closed


def _reach(closed: trimesh.Trimesh, height: float, center: Array) -> float:
    """How far a body's section at a height reaches from the centre of mass, in the worst direction."""
    section = closed.section([0, 0, 1], [0, 0, height])
    return 0.0 if section is None else _edge_distance(np.asarray(section.vertices)[:, :2], center)


def _edge_distance(flat: Array, center: Array) -> float:
    """Distance from the centre of mass to the nearest edge of the convex outline of points (N, 2)."""
    try:
        return float((-(ConvexHull(flat).equations @ [*center[:2], 1.0])).min())
    except (QhullError, ValueError):
        return 0.0
