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
    assert shape.closed().extents == pytest.approx([0.1, 0.1, 0.1])


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("mass: 1", "mas: 1", "box: unknown key 'mas' .*Did you mean mass.*1 more after this one"),
        ("mass: 1", "mass: heavy", "box: wrong value for 'mass' .expected a number, found 'heavy'"),
        ("kind: carton, radius", "kind: crate, radius", "box: wrong value for 'shape.kind' .*'carton'.* found 'crate'"),
        ("radius: 0.002", "corner: 0.002", "box: unknown key 'shape.corner' .*'kind', 'radius'"),
        ("[1, 2, 3]", "[1, 2, 256]", "box: .*'paint.label.base.2' .expected less than or equal to 255, found 256"),
        ("motif: sun", "motif: moon", "box: paint.label.motif: no such motif; known are tomato, sun.*'moon'"),
        ("mass: 1", "mass: 1\n  model: padlock", "box: a product has a shape and a paint, or a model"),
        ("mass: 1", "mass: 1\n  model: lock", "box: wrong value for 'model' .expected .*'padlock'.*found 'lock'"),
        ("  shape: {kind: carton, radius: 0.002}\n", "", "box: a product has a shape and a paint, or a model"),
        ("box:", "Box:", "Box: wrong value for 'id' .expected a string like"),
        (CARTON, "- box", "products can't be read .expected a mapping of products by id"),
        (CARTON, "box: [", "products can't be read .found while parsing"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, right, wrong, message):
    assert right in CARTON
    (tmp_path / "boxes.yaml").write_text(CARTON.replace(right, wrong))
    with pytest.raises(AssetError, match=f"boxes.yaml(, |: ){message}"):
        load_products(tmp_path)


def test_an_id_in_two_files(tmp_path):
    for name in ("boxes.yaml", "cans.yaml"):
        (tmp_path / name).write_text(CARTON)
    with pytest.raises(AssetError, match="cans.yaml, box: this product is there twice"):
        load_products(tmp_path)
