"""Units and axes of raw scans, guessed from their sizes and shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray
from shapely import MultiPoint

from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Unit = Literal["m", "cm", "mm", "inch"]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]

METRES_PER_UNIT: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
UP_AXES: tuple[str, ...] = get_args(Up)
PLAUSIBLE = (0.005, 1.5)  # m, longest side of a thing that a hand can pick up, generously
TYPICAL = 0.15  # m, longest side of a household object
GIANT = 5.0  # times the typical size: next to scans in another unit, more likely one of ten times smaller things
FAR = np.log(20)  # from the typical size, where a scan no longer tells what unit the others have
STANDS = 0.27  # thickness over height down to which people put a box on its end
BOX_FILL = 0.93  # share of its rectangle that a box's outline fills; an ellipse fills 0.785


def guess_unit(longest: Sequence[float]) -> Unit:
    """The unit in which a set of scans was made: metres, centimetres or millimetres.

    Inches are too near to centimetres to be told from sizes.

    Args:
        longest: longest side of each scan, in its unit.

    Raises:
        AssetError: in none of them are the things of a size that can be picked up.
    """
    middle = float(np.median(longest))
    best = min(("m", "cm", "mm"), key=lambda unit: abs(np.log(middle * METRES_PER_UNIT[unit] / TYPICAL)))
    if not PLAUSIBLE[0] <= middle * METRES_PER_UNIT[best] <= PLAUSIBLE[1]:
        raise AssetError(
            "can't guess the unit of the scans",
            expected=f"{PLAUSIBLE[0]} to {PLAUSIBLE[1]} m for the longest side",
            found=f"{middle:g} units",
            fix="Pass --units.",
        )
    return best  # pyright: ignore[reportReturnType]


def guess_units(longest: Mapping[str, float]) -> dict[str, Unit]:
    """The unit of each scan of a folder: that of most of them, save for those that it makes giants or crumbs.

    Args:
        longest: longest side of each scan, in its unit, by its name.

    Raises:
        AssetError: a scan is in no unit of a size that can be picked up.
    """
    cost = {
        unit: sum(min(abs(np.log(side * METRES_PER_UNIT[unit] / TYPICAL)), FAR) for side in longest.values())
        for unit in ("m", "cm", "mm")
    }
    usual: Any = min(cost, key=lambda unit: cost[unit])
    units: dict[str, Unit] = {}
    for name, side in longest.items():
        fits = PLAUSIBLE[0] <= side * METRES_PER_UNIT[usual] <= GIANT * TYPICAL
        try:
            units[name] = usual if fits else guess_unit([side])
        except AssetError as error:
            raise AssetError(
                error.what, where=name, expected=error.expected, found=error.found, fix=error.fix
            ) from error
    return units


def guess_up(mesh: trimesh.Trimesh) -> Up:
    """The axis that points up: y or z, the two that software uses.

    A thing with a long axis stands on it, unless it is a flat box; a flat thing lies on its broad side.

    Args:
        mesh: any unit.
    """
    hull = mesh.convex_hull
    x, y, z = np.ptp(hull.vertices, axis=0)
    size = {"x": x, "y": y, "z": z}
    long = max(size, key=lambda axis: size[axis])
    if long != "x":
        across = sorted(size[axis] for axis in size if axis != long)
        boxy = _fill(hull, "xyz".index(long)) > BOX_FILL
        if not boxy or across[0] / size[long] >= STANDS:
            return long  # pyright: ignore[reportReturnType]
    return "y" if y < z else "z"


def rotate_upright(mesh: trimesh.Trimesh, up: Up) -> trimesh.Trimesh:
    """A copy with an axis of the file turned to +z."""
    turned = mesh.copy(include_cache=True)  # with its normals
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    transform = np.diag([1.0, -1.0, -1.0, 1.0]) if up == "-z" else np.eye(4)
    if axis[2] == 0:
        quarter = trimesh.transformations.rotation_matrix(np.pi / 2, np.cross(axis, [0.0, 0.0, 1.0]))
        transform = np.round(quarter)  # exact, so that boxes stay boxes
    turned.apply_transform(transform)
    return turned


def _fill(hull: trimesh.Trimesh, axis: int) -> float:
    """Share of its smallest rectangle that a convex body's outline along an axis fills."""
    flat = np.delete(hull.vertices, axis, axis=1)
    outline = MultiPoint(flat).convex_hull
    return float(outline.area / outline.minimum_rotated_rectangle.area)
