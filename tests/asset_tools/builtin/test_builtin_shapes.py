from functools import cache

import numpy as np
import pytest

from asset_tools.builtin import bottles, shapes
from asset_tools.builtin.catalogue import products
from asset_tools.decompose import GPU_LIMIT, flat_faces
from asset_tools.quality.hulls import volume_iou

GRIPPER_OPENING = 0.08  # m
HOUSEHOLD = [p for p in products().values() if not p.model and p.category not in ("ball", "toy")]


# What the real things measure (m, any order) and weigh (kg).
@cache
def built(name):
    product = products()[name]
    return product.shape(product.size)


@pytest.mark.parametrize("spec", HOUSEHOLD, ids=lambda spec: spec.id)
def test_a_gripper_takes_it_and_its_weight_suits_it(spec):
    """Something of a household is between half and one and a half times as heavy as water; chips are mostly air."""
    assert min(spec.size) < GRIPPER_OPENING or spec.id == "mug"  # that one is held by its wall
    density = spec.mass / built(spec.id).closed().volume
    assert (150 if spec.id == "chips_can" else 400) < density < 1500


@pytest.mark.parametrize("spec", [s for s in HOUSEHOLD if built(s.id).pieces], ids=lambda spec: spec.id)
def test_pieces_fill_the_shape(spec):
    pieces = list(built(spec.id).pieces)
    assert len(pieces) <= (13 if spec.hollow else 8)
    assert max(map(len, pieces)) <= 48 and max(map(flat_faces, pieces)) <= GPU_LIMIT
    # of thin walls a tenth of a millimetre is a share of its own
    assert volume_iou(built(spec.id).closed(), pieces) >= (0.75 if spec.hollow else 0.9)


@pytest.mark.parametrize("spec", HOUSEHOLD, ids=lambda spec: spec.id)
def test_closed_and_of_the_declared_size(spec):
    shape = built(spec.id)
    surface = shape.closed()
    assert surface.is_watertight and surface.is_winding_consistent and surface.body_count == 1
    assert surface.volume > 0
    np.testing.assert_allclose(surface.extents, spec.size, atol=1e-4)
    np.testing.assert_allclose(surface.bounds.mean(0), 0, atol=1e-6)
    assert len(shape.faces) <= 6000


@pytest.mark.parametrize("spec", HOUSEHOLD, ids=lambda spec: spec.id)
def test_uv_and_normals(spec):
    shape = built(spec.id)
    assert shape.uv.min() >= 0 and shape.uv.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1, atol=1e-6)
    corners = shape.vertices[shape.faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    large = np.linalg.norm(face_normals, axis=1) > 1e-8
    agreement = np.einsum("fi,fci->fc", face_normals, shape.normals[shape.faces])
    assert (agreement[large] > 0).all()


@pytest.mark.parametrize("spec", HOUSEHOLD, ids=lambda spec: spec.id)
def test_texture_is_not_mirrored(spec):
    """Seen from outside, u x v points outwards: the determinant of the map from the texture keeps its sign."""
    shape = built(spec.id)
    uv = shape.uv[shape.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    assert (area > -1e-9).all()


def test_regions_do_not_overlap():
    for shape in (
        *(built(spec.id) for spec in HOUSEHOLD),
        shapes.carton((0.2, 0.01, 0.1)),
        bottles.drink_bottle((0.05, 0.05, 0.18)),
    ):
        taken = np.zeros((shape.texture_size, shape.texture_size), dtype=int)
        for region in shape.regions.values():
            left, top, right, bottom = region.box
            assert 0 < left < right < shape.texture_size and 0 < top < bottom < shape.texture_size
            taken[top:bottom, left:right] += 1
        assert taken.max() == 1
