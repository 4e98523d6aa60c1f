"""Templates of PartNet furniture fit the annotations that its import goes by; the models themselves can't travel."""

import pytest

from asset_tools.partnet.annotation import find_annotation
from robocas_ms3.scenes.config import load_task_config, shipped_configs

TEMPLATES = [name for name in shipped_configs() if "partnet" in name]


@pytest.mark.parametrize("name", TEMPLATES)
def test_surfaces_handles_and_joints_are_annotated(name):
    assert "import-partnet" in shipped_configs()[name].read_text(encoding="utf-8")
    config = load_task_config(name)
    for key, item in config.furniture.items():
        pack, _, model = item.asset.rpartition("/")
        if pack != "partnet":
            continue
        annotation = find_annotation(model)
        if config.surface.furniture == key:
            surface = annotation.surfaces[config.surface.name]
            low, high = config.surface.min_xy or surface.min_xy, config.surface.max_xy or surface.max_xy
            assert all(a >= b for a, b in zip(low, surface.min_xy, strict=True))
            assert all(a <= b for a, b in zip(high, surface.max_xy, strict=True))
        if config.opening and config.opening.furniture == key:
            assert config.opening.handle in annotation.handles
