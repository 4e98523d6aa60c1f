"""Valid entries of pack manifests."""

from typing import Any

from robocas_ms3.assets.manifest import FurnitureAsset, FurnitureQuality, ObjectAsset, ObjectQuality

COMMON: dict[str, Any] = {"category": "test", "source": "test", "licence": "MIT", "attribution": "none", "files": {}}
QUALITY = ObjectQuality(
    compact=True,
    hull_count=4,
    hull_vertices=48,
    volume_iou=0.95,
    surface_p95=0.001,
    rest_share=1,
    rest_time=0.5,
    penetration=0.0005,
    jitter=1e-6,
    grasps_tried=20,
    grasps_held=0.9,
)


def object_asset(id_: str = "thing", **facts: Any) -> ObjectAsset:
    """Return the entry of an object that satisfies all quality limits."""
    body = {"mass": 0.1, "center_of_mass": (0, 0, 0), "inertia": (1e-4, 1e-4, 1e-4), "extents": (0.1, 0.1, 0.1)}
    return ObjectAsset(**{"id": id_, "name": id_, **COMMON, **body, "grasp_count": 60, "quality": QUALITY, **facts})


def furniture_asset(id_: str = "thing", **facts: Any) -> FurnitureAsset:
    """Return the entry of a piece of furniture."""
    quality = FurnitureQuality(hull_count=1, hull_vertices=8)
    return FurnitureAsset(**{"id": id_, "name": id_, **COMMON, "extents": (1, 1, 1), "quality": quality, **facts})
