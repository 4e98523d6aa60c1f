"""Which of several mesh files are the object: one rule for versions, parts and collision meshes."""

import numpy as np
import pytest
import trimesh
from models import Gltf, box, image_file, write_obj

from asset_tools.import_scans import ImportSettings, find_scans, make_scan_jobs
from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError


def mug():
    return box((0.08, 0.08, 0.1))


def notes_of(model):
    return " | ".join(model.notes)


BODY = box((0.07, 0.08, 0.1))
FINE, MILLIMETRES, Y_UP = BODY.subdivide(), BODY.subdivide().apply_scale(1000), BODY.copy()
Y_UP.vertices = 100 * Y_UP.vertices[:, [0, 2, 1]] * [1, 1, -1]
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.07)
COLLISION = ("collision", "a_col", "a_vhacd", "a_hull", "a_coll", "a_collision_0", "a_coacd", "convex_3")


@pytest.mark.parametrize(
    ("used", "others"),
    [
        ("mug.obj", {"mug.stl": FINE, "nontextured.ply": FINE}),
        ("mug.obj", {"mug_low.glb": FINE}),
        ("mug.obj", {"a_millimetres.stl": MILLIMETRES}),
        ("mug.obj", {"mug.glb": Y_UP}),
        ("meshes/mug.obj", {"mug.stl": BODY, "collision/a.stl": BODY}),
        ("visual/mug.obj", {"collision.obj": box()}),
        *(("model.obj", {f"{name}.obj": BALL}) for name in COLLISION),
    ],
)
def test_the_textured_version_is_taken_and_others_are_reported(tmp_path, used, others):
    path = tmp_path / used
    write_obj(path.parent, path.stem, BODY)
    for name, mesh in others.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        mesh.export(tmp_path / name)
    model = read_model(tmp_path)
    assert len(model.mesh.faces) == 12 and f"used {used}" in notes_of(model)
    assert all(f"ignored {name}" in notes_of(model) for name in others)


def test_an_unreadable_version_is_ignored(tmp_path):
    write_obj(tmp_path, "mug", mug())
    (tmp_path / "mug.ply").write_bytes(b"ply\nnonsense")
    model = read_model(tmp_path)
    assert len(model.mesh.faces) == 12
    assert any(note.startswith("warning:") and "mug.ply" in note for note in model.notes)


def test_parts_are_joined(tmp_path):
    write_obj(tmp_path, "body", mug())
    write_obj(tmp_path, "handle", box((0.03, 0.01, 0.06), (0.055, 0, 0)))
    write_obj(tmp_path, "cork", box((0.03, 0.03, 0.04), (0, 0, 0.06)))
    model = read_model(tmp_path)
    np.testing.assert_allclose(model.mesh.bounds, [[-0.04, -0.04, -0.05], [0.07, 0.04, 0.08]])
    assert len(model.mesh.faces) == 36
    assert all(f"{name}.obj" in notes_of(model) for name in ("body", "handle", "cork"))


def test_a_part_inside_the_box_of_another_is_joined(tmp_path):
    cabinet = trimesh.creation.annulus(0.05, 0.06, 0.1)
    cabinet.export(tmp_path / "wall.ply")
    content = trimesh.creation.cylinder(0.045, 0.02)
    content.apply_translation([0, 0, -0.03])
    content.export(tmp_path / "content.ply")
    assert read_model(tmp_path).mesh.volume == pytest.approx(cabinet.volume + np.pi * 0.045**2 * 0.02, rel=0.02)


def test_a_part_contained_in_another_file_is_ignored(tmp_path):
    both = trimesh.util.concatenate([mug(), box((0.03, 0.01, 0.06), (0.056, 0, 0))])
    both.export(tmp_path / "whole.ply")
    mug().export(tmp_path / "body.ply")
    model = read_model(tmp_path)
    assert len(model.mesh.faces) == 24 and "ignored body.ply" in notes_of(model)


def test_several_objects_in_one_folder_are_an_error_that_names_them(tmp_path):
    plate, cup = trimesh.creation.cylinder(0.1, 0.02), trimesh.creation.cylinder(0.03, 0.1)
    for mesh, name in ((plate, "plate"), (cup, "cup")):
        mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
        mesh.export(tmp_path / f"{name}.ply")
    with pytest.raises(AssetError) as caught:
        read_model(tmp_path)
    assert "plate.ply" in str(caught.value.found) and "cup.ply" in str(caught.value.found)
    cup.apply_translation([1, 0, 0.3])
    cup.export(tmp_path / "cup.ply")
    with pytest.raises(AssetError):
        read_model(tmp_path)


def test_layouts_that_datasets_have(tmp_path):
    """YCB, Google's scanned objects, and textures or archives' leftovers next to objects."""
    write_obj(tmp_path / "ycb" / "google_16k", "textured", mug())
    mug().export(tmp_path / "ycb" / "google_16k" / "nontextured.ply")
    (tmp_path / "ycb" / "tsdf").mkdir()
    mug().subdivide().export(tmp_path / "ycb" / "tsdf" / "textured.obj")
    write_obj(tmp_path / "shoe" / "meshes", "model", mug(), color=None)
    image_file(tmp_path / "shoe" / "materials" / "textures" / "skin.png")
    image_file(tmp_path / "shoe" / "thumbnails" / "0.jpg")
    image_file(tmp_path / "textures" / "wood.png")
    image_file(tmp_path / "photos" / "1.png")
    (tmp_path / "__MACOSX").mkdir()
    box().export(tmp_path / "__MACOSX" / "x.ply")
    write_obj(tmp_path, "cup", mug())
    mug().export(tmp_path / "cup.stl")
    mug().export(tmp_path / "cup_collision.stl")
    Gltf(mug()).write(tmp_path / "bowl" / "bowl.glb")
    image_file(tmp_path / "bowl" / "preview.png")
    (tmp_path / "soft").mkdir()
    (tmp_path / "soft" / "soft.fbx").write_bytes(b"Kaydara")
    found = find_scans(tmp_path)
    assert sorted(found.models) == ["bowl", "cup", "shoe", "soft", "ycb"]
    assert not found.errors
    skipped = " ".join(found.skipped)
    assert all(name in skipped for name in ("textures", "photos", "__MACOSX", "cup_collision.stl"))
    for name in ("ycb", "shoe", "cup"):
        model = read_model(list(found.models[name].paths), tmp_path)
        assert len(model.mesh.faces) == 12 and any(path.name == "skin.png" for path in model.files)
    assert len(read_model(list(found.models["bowl"].paths), tmp_path).mesh.faces) == 12
    with pytest.raises(AssetError) as caught:
        read_model(list(found.models["soft"].paths), tmp_path)
    assert ".fbx" in str(caught.value.found)


def test_two_scans_with_one_id_fail_alone(tmp_path):
    write_obj(tmp_path, "mug")
    write_obj(tmp_path / "Mug", "other")
    write_obj(tmp_path / "cup")
    jobs = {job.id: job for job in make_scan_jobs(tmp_path, ImportSettings())}
    assert sorted(jobs) == ["cup", "mug"]
    with pytest.raises(AssetError):
        jobs["mug"].make(tmp_path / "out")


@pytest.mark.parametrize(
    ("names", "sizes", "middles"),
    [
        (("body/mesh", "lid/mesh"), ((0.06, 0.06, 0.1), (0.06, 0.06, 0.01)), ((0, 0, 0), (0, 0, 0.055))),
        (("drawer_low", "drawer_high"), ((0.06, 0.06, 0.05), (0.06, 0.06, 0.05)), ((0, 0, 0), (0, 0, 0.05))),
        (("cube", "knob"), ((0.1, 0.1, 0.1), (0.01, 0.01, 0.01)), ((0, 0, 0), (0, 0, 0.055))),
        (("base", "pole"), ((0.1, 0.1, 0.02), (0.02, 0.02, 0.4)), ((0, 0, 0.01), (0, 0, 0.2))),
        (("boat_hull", "boat_cabin"), ((0.2, 0.06, 0.05), (0.05, 0.04, 0.04)), ((0, 0, 0), (0.02, 0, 0.045))),
    ],
    ids=lambda value: value[0] if isinstance(value[0], str) else "",
)
def test_parts_that_look_like_versions(tmp_path, names, sizes, middles):
    parts = [box(size, at) for size, at in zip(sizes, middles, strict=True)]
    for name, part in zip(names, parts, strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        part.export(tmp_path / f"{name}.ply")
    model = read_model(tmp_path)
    assert len(model.mesh.faces) == 24
    np.testing.assert_allclose(model.mesh.area, sum(part.area for part in parts), rtol=1e-5)


def test_of_versions_without_texture_the_most_detailed_one_is_taken(tmp_path):
    mug().export(tmp_path / "a.ply")
    mug().subdivide().export(tmp_path / "b.ply")
    assert len(read_model(tmp_path).mesh.faces) == 48


def test_a_textured_label_around_a_can(tmp_path):
    trimesh.creation.cylinder(0.03, 0.1, sections=48).export(tmp_path / "can.ply")
    wall = trimesh.creation.cylinder(0.03, 0.1, sections=48)
    wall.update_faces(np.abs(wall.face_normals[:, 2]) < 0.5)
    write_obj(tmp_path, "label", wall)
    model = read_model(tmp_path)
    assert len(model.mesh.faces) > len(wall.faces) and any(path.name == "skin.png" for path in model.files)


def test_only_a_folder_of_collision_meshes(tmp_path):
    (tmp_path / "collision").mkdir()
    mug().export(tmp_path / "collision" / "a.stl")
    assert len(read_model(tmp_path).mesh.faces) == 12
