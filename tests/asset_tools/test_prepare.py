"""Bases that bulge are pressed flat, and only those; real scans stand as they do in life."""

import numpy as np
import pytest
import trimesh

from asset_tools.decompose import decompose_mesh
from asset_tools.inertia import compute_principal_inertia
from asset_tools.prepare import flatten_base, prepare_scan
from asset_tools.resting_poses import find_resting_poses
from robocas_ms3.assets.physics import RigidBody
from robocas_ms3.core.errors import AssetError


def carton(bulge, size=0.07, height=0.19):
    """A box whose base is a dome that is deepest in the middle, by ``bulge`` m; its edges at z = 0."""
    mesh = trimesh.creation.box([size, size, height])
    for _ in range(4):
        mesh = mesh.subdivide()
    mesh.apply_translation([0, 0, height / 2])
    x, y, z = mesh.vertices.T
    dome = bulge * (1 - (2 * x / size) ** 2) * (1 - (2 * y / size) ** 2)
    mesh.vertices = np.column_stack([x, y, np.where(z < 1e-9, -dome, z)])
    return mesh


def poses_of(closed):
    inertia, axes = compute_principal_inertia(closed, 0.3)
    hulls = decompose_mesh(closed).hulls
    return find_resting_poses(RigidBody(hulls, 0.3, closed.center_mass, np.array(inertia), np.array(axes)))


def test_a_bulging_base_is_pressed_flat():
    scan, repairs = carton(0.0015), []
    mesh, closed = flatten_base(scan.copy(), scan, repairs)
    assert len(repairs) == 1 and repairs[0].startswith("pressed the base flat by ")
    depth = float(repairs[0].split()[-2]) / 1e3
    assert depth < 0.0015
    for leveled in (mesh, closed):
        assert leveled.bounds[0, 2] == pytest.approx(-0.0015 + depth, abs=1e-4)
        np.testing.assert_allclose(leveled.bounds[1], scan.bounds[1])
    assert closed.is_watertight
    assert scan.volume > closed.volume > 0.99 * scan.volume
    assert poses_of(closed).display_pose >= 0
    again: list[str] = []
    flatten_base(mesh, closed, again)
    assert again == []


def test_axis_and_unit_can_be_given(tmp_path):
    trimesh.creation.box([1.0, 2.0, 5.0]).export(tmp_path / "box.ply")
    scan = prepare_scan(tmp_path / "box.ply", up="x", unit="inch")
    assert (scan.up, scan.unit) == ("x", "inch")
    np.testing.assert_allclose(sorted(scan.closed.extents), [0.0254, 0.0508, 0.127])
    assert scan.closed.extents[2] == pytest.approx(0.0254)
    assert {"rotated x up", "scaled from inches"} <= set(scan.repairs)
    with pytest.raises(AssetError, match="no such mesh"):
        prepare_scan(tmp_path / "lost.ply")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["alphabet_soup", "ketchup", "orange_juice", "salad_dressing"])
def test_objects_that_stand_in_reality_stand_in_the_simulation(shared_dir, name):
    scan = prepare_scan(shared_dir / "scans" / "hope" / name, unit="cm")
    found = decompose_mesh(scan.closed)
    assert found.volume_iou >= 0.9
    assert len(found.hulls) <= 8
    assert poses_of(scan.closed).display_pose >= 0


QUARTER = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])


@pytest.mark.parametrize(
    "body",
    [
        carton(0.0),
        carton(-0.003),  # hollowed: supported by its edges
        trimesh.creation.icosphere(4, 0.04),
        trimesh.creation.capsule(0.1, 0.02),
        trimesh.creation.cylinder(0.03, 0.1, sections=64, transform=QUARTER),
    ],
    ids=["flat", "hollow", "ball", "capsule", "lying"],
)
def test_other_bases_are_not_flattened(body):
    repairs: list[str] = []
    mesh, closed = flatten_base(body.copy(), body, repairs)
    assert repairs == []
    assert closed is body and mesh.volume == pytest.approx(body.volume)
