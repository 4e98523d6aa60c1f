"""Measure the quality of the objects of a pack, and check it against the requirements for a pack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from asset_tools.quality.drops import DropReport, run_drop_test
from asset_tools.quality.grasp_hold import run_hold_test
from asset_tools.quality.hulls import measure_hull_quality
from robocas_ms3.assets.annotations import Annotations
from robocas_ms3.assets.manifest import ObjectAsset, ObjectQuality
from robocas_ms3.assets.pack import LoadedObject
from robocas_ms3.assets.physics import RigidBody

TOP_GRASPS = 20

# requirements for each object
COMPACT_OVERLAP = 0.80  # volume IoU of hulls and closed mesh, for compact objects
SURFACE_DISTANCE = 0.004  # m, 95th percentile, for thin or hollow objects
HULL_VERTICES = 64  # limit of PhysX on a GPU
REST_SHARE = 0.90  # fraction of drops
REST_TIME = 2.0  # s
PENETRATION = 0.002  # m
JITTER = 0.05  # J/kg, for all drops that do not roll; a tenth of the energy of the fall
GRASPS = 50  # per object, or a reason in the manifest
# requirements for medians over the pack
MEDIAN_OVERLAP = 0.90
MEDIAN_HULLS = 8
MEDIAN_HELD = 0.80  # fraction of the top grasps


@dataclass(frozen=True)
class Violation:
    """A requirement for a pack that is not met.

    Attributes:
        asset: id of the asset; empty: the requirement is for the whole pack.
        what: measured quantity, such as "volume IoU".
        expected: required value as text.
        found: measured value as text.
    """

    asset: str
    what: str
    expected: str
    found: str


def measure_object(
    closed: trimesh.Trimesh, solid: RigidBody, annotations: Annotations, *, hollow: bool = False
) -> ObjectQuality:
    """Measure the quality of an object during its build; deterministic.

    The function compares the hulls with the closed mesh, drops the object, and tests its best 20 grasps.

    Args:
        closed: watertight mesh from which the hulls were made, in the object's frame, m.
        solid: the object with the hulls read from ``hulls.obj``.
        annotations: resting poses and grasps of the object.
        hollow: whether the object is a container, whose hulls are judged by surface distance.
    """
    hulls = measure_hull_quality(closed, list(solid.hulls), hollow=hollow)
    return ObjectQuality(
        compact=hulls.compact,
        hull_count=hulls.hull_count,
        hull_vertices=hulls.hull_vertices,
        volume_iou=round(hulls.volume_iou, 4),
        surface_p95=round(hulls.surface_p95, 6),
        **_physics(solid, annotations),
    )


def measure_object_again(loaded: LoadedObject) -> ObjectQuality:
    """Measure the quality of an object of a pack again: hull sizes, drops and grasps; deterministic.

    The comparison of the hulls with the closed mesh is copied from the manifest, since packs do not contain this mesh.
    """
    facts = loaded.asset
    solid = RigidBody(
        loaded.hulls,
        facts.mass,
        np.array(facts.center_of_mass),
        np.array(facts.inertia),
        np.array(facts.inertia_wxyz),
        facts.friction,
    )
    return ObjectQuality(
        compact=facts.quality.compact,
        hull_count=len(solid.hulls),
        hull_vertices=max(len(hull) for hull in solid.hulls),
        volume_iou=facts.quality.volume_iou,
        surface_p95=facts.quality.surface_p95,
        **_physics(solid, loaded.annotations),
    )


def select_top_grasps(annotations: Annotations) -> NDArray[np.intp]:
    """Return the indices (K,) of the 20 grasps with the lowest required friction, best first."""
    return np.argsort(annotations.grasp_qualities, kind="stable")[:TOP_GRASPS]


def check_objects(assets: Mapping[str, ObjectAsset]) -> list[Violation]:
    """Return the requirements that objects do not meet, one by one or in the medians over the pack.

    Args:
        assets: id -> object with its measured quality.
    """
    found: list[Violation] = []
    for name, asset in assets.items():
        quality = asset.quality
        overlap, distance = quality.volume_iou, quality.surface_p95
        checks = [
            (
                quality.hull_vertices <= HULL_VERTICES,
                "vertices of a hull",
                f"<= {HULL_VERTICES}",
                quality.hull_vertices,
            ),
            (quality.rest_share >= REST_SHARE, "drops at rest", f">= {REST_SHARE:.0%}", f"{quality.rest_share:.0%}"),
            (quality.rest_time <= REST_TIME, "median time to rest", f"<= {REST_TIME:g} s", f"{quality.rest_time:g} s"),
            (quality.penetration <= PENETRATION, "penetration", _mm_below(PENETRATION), _mm(quality.penetration)),
            (quality.jitter <= JITTER, "jitter", f"<= {JITTER:g} J/kg", f"{quality.jitter:.2g} J/kg"),
            (
                asset.grasp_count >= GRASPS or bool(asset.no_grasps_because),
                "number of grasps",
                f">= {GRASPS}, or a reason",
                asset.grasp_count,
            ),
        ]
        if quality.compact:
            checks.append((overlap >= COMPACT_OVERLAP, "volume IoU", f">= {COMPACT_OVERLAP:.2f}", f"{overlap:.2f}"))
        else:
            what = "distance of the surfaces"
            checks.append((distance <= SURFACE_DISTANCE, what, _mm_below(SURFACE_DISTANCE), _mm(distance)))
        found += [Violation(name, what, limit, str(value)) for good, what, limit, value in checks if not good]
    return found + _check_medians([asset.quality for asset in assets.values()])


def compare_with_manifest(loaded: LoadedObject, measured: ObjectQuality) -> list[Violation]:
    """Return the differences between the quality of an object in its manifest and a new measurement.

    Args:
        loaded: the object.
        measured: result of `measure_object_again` for this object.
    """
    asset = loaded.asset
    stored, found = asset.quality.model_dump(), measured.model_dump()
    pairs = [(name, stored[name], found[name]) for name in stored if stored[name] != found[name]]
    grasps = len(loaded.annotations.grasp_widths)
    if asset.grasp_count != grasps:
        pairs.append(("grasp_count", asset.grasp_count, grasps))
    return [
        Violation(asset.id, f"measured {name}", f"{value:g} (manifest)", f"{other:g}") for name, value, other in pairs
    ]


HEADER = ("object", "kind", "hulls", "IoU (stored)", "p95 mm (stored)", "rest %", "rolling %", "rest s", "sunk mm") + (
    "jitter mJ/kg",
    "held %",
)


def make_object_rows(qualities: Mapping[str, ObjectQuality]) -> list[tuple[str, ...]]:
    """Return one table row per object with the columns of `HEADER`, and a last row of medians.

    The median of the IoU is over compact objects, that of p95 is over thin or hollow objects, and that of held grasps
    is over objects with grasps.

    Args:
        qualities: id of an object -> quality.
    """

    def row(name: str, kind: str, numbers: Sequence[float]) -> tuple[str, ...]:
        formats = ("g", ".2f", ".1f", ".0f", ".0f", ".2f", ".2f", ".3f", ".0f")
        cells = ("-" if np.isnan(x) else format(x, f) for x, f in zip(numbers, formats, strict=True))
        return (name, kind, *cells)

    table, columns = [], []
    for name, q in qualities.items():
        numbers = [
            q.hull_count,
            q.volume_iou,
            1e3 * q.surface_p95,
            100 * q.rest_share,
            100 * q.rolling_share,
            q.rest_time,
            1e3 * q.penetration,
            1e3 * q.jitter,
            100 * q.grasps_held if q.grasps_tried else np.nan,
        ]
        table.append(row(name, "compact" if q.compact else "thin", numbers))
        numbers[2 if q.compact else 1] = np.nan
        columns.append(numbers)
    if table:
        kept = [values[np.isfinite(values)] for values in np.array(columns).T]
        table.append(row("median", "", [float(np.median(values)) if len(values) else np.nan for values in kept]))
    return table


def _physics(solid: RigidBody, annotations: Annotations) -> dict[str, Any]:
    """Run the drop test and the hold test; return the fields of `ObjectQuality` that they measure."""
    dropped = run_drop_test(solid, annotations.resting_poses)
    grasps = np.asarray(annotations.grasps_tcp_in_object, float)[select_top_grasps(annotations)]
    held = run_hold_test(solid, grasps)
    return dict(
        rest_share=round(float(dropped.good.mean()), 4),
        rolling_share=round(float(np.mean(dropped.good & dropped.rolling)), 4),
        rest_time=round(float(np.median(dropped.rest_times)), 4),
        penetration=round(float(dropped.penetrations.max()), 6),
        jitter=round(_jitter(dropped) / solid.mass, 9),
        grasps_tried=len(grasps),
        grasps_held=round(float(held.mean()), 4) if len(grasps) else 0.0,
    )


def _jitter(dropped: DropReport) -> float:
    """Return the largest kinetic energy in J in the last second of all drops without rolling."""
    return float(max(dropped.jitters[~dropped.rolling], default=0.0))


def _check_medians(qualities: list[ObjectQuality]) -> list[Violation]:
    """Return the requirements for medians over the objects of a pack that are not met."""
    medians = [
        ("median volume IoU", [q.volume_iou for q in qualities if q.compact], MEDIAN_OVERLAP, ".2f", True),
        ("median hulls", [q.hull_count for q in qualities], MEDIAN_HULLS, "g", False),
        ("median of grasps held", [q.grasps_held for q in qualities if q.grasps_tried], MEDIAN_HELD, ".0%", True),
    ]
    found = []
    if qualities and not any(q.grasps_tried for q in qualities):
        found.append(Violation("", "number of objects that can be grasped", ">= 1", "0"))
    for what, values, limit, form, at_least in medians:
        if values:
            median = float(np.median(values))
            if median < limit if at_least else median > limit:
                sign = ">=" if at_least else "<="
                found.append(Violation("", what, f"{sign} {limit:{form}}", f"{median:{form}}"))
    return found


def _mm(length: float) -> str:
    return f"{1e3 * length:.1f} mm"


def _mm_below(length: float) -> str:
    return f"<= {1e3 * length:g} mm"
