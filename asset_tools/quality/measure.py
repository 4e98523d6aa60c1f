"""Measure an object of a pack, and hold what was measured against what a pack promises."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from asset_tools.physics import Array, Solid
from asset_tools.quality.drops import DropReport, drop_test
from asset_tools.quality.holding import hold_test
from asset_tools.quality.hulls import hull_quality
from robocas_ms3.assets.annotations import Annotations
from robocas_ms3.assets.manifest import ObjectQuality
from robocas_ms3.assets.pack import LoadedObject

TOP_GRASPS = 20

# What a pack promises. Of each object:
COMPACT_OVERLAP = 0.80  # volume IoU of hulls and closed mesh, of compact objects
SURFACE_DISTANCE = 0.004  # m, 95th percentile, of thin or hollow ones
HULL_VERTICES = 64  # more don't go into a GPU's hull
REST_SHARE = 0.90  # of drops
REST_TIME = 2.0  # s
PENETRATION = 0.002  # m
JITTER = 1e-3  # J; a drop counts as at rest below 4.5e-4 J per kg anyway
# Of the median over the pack:
MEDIAN_OVERLAP = 0.90
MEDIAN_HULLS = 8
MEDIAN_HELD = 0.80  # of the top grasps


@dataclass(frozen=True)
class Violation:
    """A promise that is broken.

    Attributes:
        asset: its id; empty: the pack as a whole.
        what: was measured.
        expected: of it.
        found: instead.
    """

    asset: str
    what: str
    expected: str
    found: str


def measure_object(
    closed: trimesh.Trimesh, solid: Solid, annotations: Annotations, *, hollow: bool = False
) -> ObjectQuality:
    """Measure an object when it is made. The same input gives the same numbers.

    Args:
        closed: watertight mesh that the hulls were made from, m, the asset's frame.
        solid: the object as the engine knows it; hulls as they are read back from ``hulls.obj``.
        annotations: its resting poses and grasps.
        hollow: a container, to be judged by the distance of the surfaces.
    """
    hulls = hull_quality(closed, list(solid.hulls), hollow=hollow)
    return ObjectQuality(
        compact=hulls.compact,
        hull_count=hulls.hull_count,
        hull_vertices=hulls.hull_vertices,
        volume_iou=round(hulls.volume_iou, 4),
        surface_p95=round(hulls.surface_p95, 6),
        **_physics(solid, annotations),
    )


def remeasure(loaded: LoadedObject) -> ObjectQuality:
    """Measure hull sizes, drops and grasps of an object of a pack anew.

    How close the hulls are to the closed mesh is taken over from the manifest, since packs don't keep that mesh.
    """
    facts = loaded.asset
    solid = Solid(
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


def top_grasps(annotations: Annotations, count: int = TOP_GRASPS) -> Array:
    """The best grasps (K, 4, 4): lowest friction first, equals in the order of the annotations, better ones first."""
    order = np.argsort(annotations.grasp_qualities, kind="stable")[:count]
    return np.asarray(annotations.grasps_tcp_in_object, float)[order]


def judge(qualities: Mapping[str, ObjectQuality]) -> list[Violation]:
    """Say which promises a pack's objects break, object by object and then over all.

    Args:
        qualities: by asset id.
    """
    found: list[Violation] = []
    for asset, quality in qualities.items():
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
            (quality.jitter <= JITTER, "jitter", f"<= {JITTER:g} J", f"{quality.jitter:.2g} J"),
        ]
        if quality.compact:
            checks.append((overlap >= COMPACT_OVERLAP, "volume IoU", f">= {COMPACT_OVERLAP:.2f}", f"{overlap:.2f}"))
        else:
            name = "distance of the surfaces"
            checks.append((distance <= SURFACE_DISTANCE, name, _mm_below(SURFACE_DISTANCE), _mm(distance)))
        found += [Violation(asset, what, limit, str(value)) for good, what, limit, value in checks if not good]
    return found + _judge_medians(list(qualities.values()))


HEADER = ("object", "kind", "hulls", "IoU", "p95 mm", "rest %", "rest s", "sunk mm", "jitter mJ", "held %")


def rows(qualities: Mapping[str, ObjectQuality]) -> list[tuple[str, ...]]:
    """The table: a row of text for each object, as `HEADER` names it, and a last one of the medians."""

    def row(name: str, kind: str, numbers: list[float]) -> tuple[str, ...]:
        formats = ("g", ".2f", ".1f", ".0f", ".2f", ".2f", ".3f", ".0f")
        cells = ("-" if np.isnan(x) else format(x, f) for x, f in zip(numbers, formats, strict=True))
        return (name, kind, *cells)

    numbers = {
        name: [
            q.hull_count,
            q.volume_iou,
            1e3 * q.surface_p95,
            100 * q.rest_share,
            q.rest_time,
            1e3 * q.penetration,
            1e3 * q.jitter,
            100 * q.grasps_held if q.grasps_tried else np.nan,
        ]
        for name, q in qualities.items()
    }
    table = [row(name, "compact" if qualities[name].compact else "thin", values) for name, values in numbers.items()]
    if numbers:
        values = np.array(list(numbers.values()))
        graspable = np.isfinite(values[:, -1]).any()
        medians = [*np.median(values[:, :-1], axis=0), np.nanmedian(values[:, -1]) if graspable else np.nan]
        table.append(row("median", "", medians))
    return table


def _physics(solid: Solid, annotations: Annotations) -> dict[str, Any]:
    """The fields of `ObjectQuality` that come out of the engine."""
    dropped = drop_test(solid, annotations.resting_poses)
    grasps = top_grasps(annotations)
    held = hold_test(solid, grasps)
    return dict(
        rest_share=round(float(dropped.good.mean()), 4),
        rest_time=round(float(np.median(dropped.rest_times)), 4),
        penetration=round(float(dropped.penetrations.max()), 6),
        jitter=round(_jitter(dropped), 9),
        grasps_tried=len(grasps),
        grasps_held=round(float(held.mean()), 4) if len(grasps) else 0.0,
    )


def _jitter(dropped: DropReport) -> float:
    """Largest kinetic energy at rest, J, of drops that don't roll; if none came to rest, of those that should have."""
    still = ~dropped.rolling
    chosen = still & dropped.good if (still & dropped.good).any() else still
    return float(max(dropped.jitters[chosen], default=0.0))


def _judge_medians(qualities: list[ObjectQuality]) -> list[Violation]:
    """Promises of the pack as a whole. Thin or hollow objects don't count in the overlap."""
    medians = [
        ("median volume IoU", [q.volume_iou for q in qualities if q.compact], MEDIAN_OVERLAP, ".2f", True),
        ("median hulls", [q.hull_count for q in qualities], MEDIAN_HULLS, "g", False),
        ("median of grasps held", [q.grasps_held for q in qualities if q.grasps_tried], MEDIAN_HELD, ".0%", True),
    ]
    found = []
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
