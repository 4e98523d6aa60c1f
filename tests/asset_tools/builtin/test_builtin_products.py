"""Files of products that are wrong."""

import pytest

from asset_tools.builtin.catalogue import load_products
from robocas_ms3.core.errors import AssetError

CARTON = """
box:
  category: box
  graspnet_id: 1
  size: [0.1, 0.1, 0.1]
  mass: 1
  shape: {kind: carton, radius: 0.002}
  paint: {kind: carton, label: {title: BOX, base: [1, 2, 3], accent: [4, 5, 6], ink: [7, 8, 9], motif: sun}}
"""


def test_whole_numbers_lists_and_defaults(tmp_path):
    (tmp_path / "boxes.yaml").write_text(CARTON)
    box = load_products(tmp_path)["box"]
    assert (box.name, box.mass, box.size, box.hollow, box.roughness) == ("box", 1.0, (0.1, 0.1, 0.1), False, 0.45)
    assert (box.shape.radius, box.paint.label.title, box.paint.label.style) == (0.002, "BOX", "bands")
    shape, _ = box.build()
    assert shape.make_closed_mesh().extents == pytest.approx([0.1, 0.1, 0.1])


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("mass: 1", "mas: 1"),
        ("mass: 1", "mass: heavy"),
        ("kind: carton, radius", "kind: crate, radius"),
        ("[1, 2, 3]", "[1, 2, 256]"),
        ("motif: sun", "motif: moon"),
        ("mass: 1", "mass: 1\n  model: padlock"),
        ("mass: 1", "mass: 1\n  model: lock"),
        ("  shape: {kind: carton, radius: 0.002}\n", ""),
        ("box:", "Box:"),
        (CARTON, "- box"),
        (CARTON, "box: ["),
    ],
)
def test_invalid_values_are_named(tmp_path, right, wrong):
    (tmp_path / "boxes.yaml").write_text(CARTON.replace(right, wrong))
    with pytest.raises(AssetError) as error:
        load_products(tmp_path)
    assert "boxes.yaml" in str(error.value.where)


def test_an_id_in_two_files(tmp_path):
    for name in ("boxes.yaml", "cans.yaml"):
        (tmp_path / name).write_text(CARTON)
    with pytest.raises(AssetError, match="cans.yaml: two products have the same id .found box"):
        load_products(tmp_path)
