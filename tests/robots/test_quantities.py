import pytest

from robocas_ms3.robots.quantities import Quantity


def test_an_optional_quantity_has_no_lerobot_feature():
    with pytest.raises(ValueError):
        Quantity("gap", "float32", ("T", 1), "m", "between the pads", feature="observation.gap", optional=True)
