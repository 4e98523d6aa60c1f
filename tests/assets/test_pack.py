import json
import os

import numpy as np
import pytest
from made_up_assets import furniture_asset, object_asset
from pydantic import ValidationError

from robocas_ms3.assets.annotations import Annotations, footprints
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.manifest import (
    Joint,
    Link,
    PackManifest,
)
from robocas_ms3.assets.pack import load_pack, pack_folders, sha256
from robocas_ms3.core.errors import AssetError

BOX = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.03, 0.03) for z in (-0.02, 0.02)])


def notes(**changes):
    upright, on_end = np.eye(4), np.eye(4)
    upright[2, 3] = 0.02
    on_end[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    on_end[2, 3] = 0.05
    values = {
        "resting_poses": np.stack([upright, on_end]),
        "footprints": footprints([BOX], np.stack([upright, on_end])),
        "resting_probabilities": np.array([0.7, 0.3]),
        "display_pose": 0,
        "grasps_tcp_in_object": np.eye(4)[None],
        "grasp_widths": np.array([0.06]),
        "grasp_qualities": np.array([0.1]),
        "surface_points": BOX,
        "surface_normals": np.tile([0.0, 0, 1], (8, 1)),
    }
    return Annotations(**{**values, **changes})


@pytest.fixture
def box_pack(tmp_path):
    root = tmp_path / "packs" / "boxes"
    folder = root / "box"
    folder.mkdir(parents=True)
    write_hulls(folder / "hulls.obj", [BOX])
    notes().save(folder / "annotations.npz")
    for name in ("visual_fast.glb", "visual_full.glb"):
        (folder / name).write_bytes(b"glTF")
    names = ("hulls.obj", "annotations.npz", "visual_fast.glb", "visual_full.glb")
    files = {name: sha256(folder / name) for name in names}
    asset = object_asset("box", extents=(0.1, 0.06, 0.04), inertia=(1e-5, 1e-5, 1e-5), files=files)
    (root / "manifest.json").write_text(PackManifest(name="boxes", assets=[asset]).model_dump_json())
    return root


def test_a_pack_is_found_by_name_and_by_path(box_pack, monkeypatch):
    monkeypatch.setenv("ROBOCAS_DATA", str(box_pack.parent.parent))
    assert "boxes" in pack_folders()
    assert load_pack("boxes").objects.keys() == load_pack(box_pack).objects.keys() == {"box"}
    with pytest.raises(AssetError, match=r"spam: no such asset pack.*boxes.*import-scans.*import-partnet"):
        load_pack("spam")


def test_geometry_of_an_object(box_pack):
    box = load_pack(box_pack).objects["box"]
    assert [len(hull) for hull in box.hulls] == [8]
    np.testing.assert_allclose(np.ptp(box.annotations.footprint(0), axis=0), [0.1, 0.06], atol=1e-6)
    np.testing.assert_allclose(np.ptp(box.annotations.footprint(1), axis=0), [0.04, 0.06], atol=1e-6)
    points = box.surface_points(0.01)
    assert points is box.surface_points(0.01)
    np.testing.assert_allclose(np.abs(points).max(axis=0), [0.05, 0.03, 0.02], atol=1e-6)
    assert box.annotations.display_pose == 0 and box.annotations.grasp_widths[0] == pytest.approx(0.06)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), r"hulls\.obj: this file of the asset pack is missing"),
        (lambda path: path.write_text(path.read_text()[:-20]), r"hulls\.obj: .*changed or cut short"),
        (lambda path: path.write_text(""), r"hulls\.obj: .*changed or cut short"),
    ],
)
def test_damaged_files_are_found_even_after_a_good_load(box_pack, damage, message):
    load_pack(box_pack)
    damage(box_pack / "box" / "hulls.obj")
    with pytest.raises(AssetError, match=message) as caught:
        load_pack(box_pack)
    assert "\n" not in str(caught.value)


def test_a_damaged_manifest_says_where(box_pack):
    path = box_pack / "manifest.json"
    data = json.loads(path.read_text())
    data["assets"][0]["mass"] = -1
    path.write_text(json.dumps(data))
    with pytest.raises(AssetError, match=r"manifest\.json: the manifest is damaged.*mass"):
        load_pack(box_pack)
    path.write_text(path.read_text()[:100])
    with pytest.raises(AssetError, match="the manifest is damaged"):
        load_pack(box_pack)


@pytest.mark.parametrize(
    ("instead", "found"),
    [('"schema_version":1,', "1"), ('"schema_version":2.0,', "2.0"), ('"schema_version":"2",', "'2'"), ("", "none")],
)
def test_a_pack_of_another_format_says_so(box_pack, instead, found):
    path = box_pack / "manifest.json"
    path.write_text(path.read_text().replace('"schema_version":2,', instead))
    message = rf"another format \(expected pack format 2, found {found}\).*Make the pack again"
    with pytest.raises(AssetError, match=message):
        load_pack(box_pack)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": "0.1"}, r"'assets\.0\.mass' .expected a number"),
        ({"friction": float("inf")}, r"friction' .expected a finite number, found inf"),
        ({"grasp_count": 1.0}, "grasp_count' .expected a whole number"),
        ({"extents": [0.1, -0.06, 0.04]}, r"extents\.1' .expected greater than or equal to 0"),
        ({"inertia_wxyz": [1, 0.1, 0, 0]}, "no unit quaternion"),
        ({"inertia": [1e-5, 1e-5, 2.1e-5]}, "no body has the moments of inertia"),
        ({"files": {"hulls.obj": "0" * 63}}, r"files\.hulls\.obj' .expected a string like"),
        ({"files": {"Hulls.obj": "0" * 64}}, r"files\.Hulls\.obj' .expected a string like"),
        ({"files": {"../hulls.obj": "0" * 64}}, "no plain path inside the asset's folder"),
        ({"files": {"/hulls.obj": "0" * 64}}, "no plain path inside"),
    ],
)
def test_manifests_that_make_no_sense(box_pack, changes, message):
    path = box_pack / "manifest.json"
    data = json.loads(path.read_text())
    data["assets"][0].update(changes)
    path.write_text(json.dumps(data))
    with pytest.raises(AssetError, match=f"the manifest is damaged.*{message}") as caught:
        load_pack(box_pack)
    assert "\n" not in str(caught.value)


def test_moments_of_inertia_may_be_rounded():
    body = {"name": "lid", "joint": JOINT, "mass": 1, "center_of_mass": (0, 0, 0)}
    Link.model_validate(body | {"inertia": (0.5, 0.497, 1)})
    with pytest.raises(ValidationError, match="no body has"):
        Link.model_validate(body | {"inertia": (0.5, 0.487, 1)})


def test_a_file_that_is_not_listed(box_pack):
    (box_pack / "box" / ".DS_Store").write_text("hidden ones don't count")
    load_pack(box_pack)
    (box_pack / "box" / "links").mkdir()
    (box_pack / "box" / "links" / "more.glb").write_text("glTF")
    with pytest.raises(AssetError, match=r"box/links/more\.glb: .*doesn't list this file"):
        load_pack(box_pack)


JOINT = {"name": "j", "kind": "prismatic", "axis": (1, 0, 0), "limits": (0, 0.3), "friction": 0.1, "damping": 1.0}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axis": (1, 1, 0)}, "no unit vector"),
        ({"limits": (0.1, 0.3)}, "0, which is closed"),
        ({"limits": (0, 0)}, "0,"),
    ],
)
def test_joints_that_make_no_sense(changes, message):
    Joint(**JOINT)
    with pytest.raises(ValidationError, match=message):
        Joint(**JOINT | changes)


SURFACE = {"link": "", "min_xy": (0, 0), "max_xy": (1, 1), "z": 0}


def link(name="door", joint="hinge", parent=""):
    facts = {"mass": 1, "center_of_mass": (0, 0, 0), "inertia": (1, 1, 1)}
    return {"name": name, "parent": parent, "joint": JOINT | {"name": joint}} | facts


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"surfaces": {"top": SURFACE | {"link": "drawer"}}}, "'top' belongs to link 'drawer', which is not there"),
        ({"surfaces": {"top": SURFACE | {"max_xy": (1, 0)}}}, "must lie below max_xy"),
        ({"links": (link(parent="box"),)}, "hangs on 'box'"),
        ({"links": (link(), link(joint="slide"))}, "two links are called 'door'"),
        ({"links": (link(), link(name="drawer"))}, "two joints are called 'hinge'"),
        ({"links": (link(name="body"),)}, "'body' is the fixed one"),
        ({"links": (link(joint="body"),)}, "'body' is the fixed one"),
        ({"finishes": {"wall": ()}}, "at least 1 item"),
        ({"mass": 2.0}, "needs its inertia too"),
        (
            {
                "links": (link(),),
                "handles": {"a": {"link": "door", "position": (0, 0, 0), "wxyz": (0.7, 0, 0, 0.7), "width": 0.02}},
            },
            "no unit quaternion",
        ),
    ],
)
def test_furniture_that_makes_no_sense(changes, message):
    furniture_asset(surfaces={"top": SURFACE}, links=(link(),))
    with pytest.raises(ValidationError, match=message):
        furniture_asset(**changes)


def test_a_footprint_has_each_corner_once():
    slab = np.array([[x, y, z] for x, y in ((0.03, 0), (-0.02, 0.02), (-0.02, -0.02)) for z in (-0.01, 0.01)])
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # on its edge: a rectangle of 0.02 x 0.04
    found = notes(resting_poses=poses, footprints=footprints([slab], poses))
    assert len(found.footprint(0)) == 3 and len(found.footprint(1)) == 4
    np.testing.assert_allclose(np.ptp(found.footprint(1), axis=0), [0.02, 0.04])


def test_a_manifest_that_forgets_a_file(box_pack):
    path = box_pack / "manifest.json"
    data = json.loads(path.read_text())
    del data["assets"][0]["files"]["hulls.obj"]
    path.write_text(json.dumps(data))
    with pytest.raises(AssetError, match=r"lists no such file \(expected box/hulls\.obj"):
        load_pack(box_pack)


def test_annotations_refuse_wrong_shapes_and_pickles(tmp_path):
    with pytest.raises(AssetError, match="grasps_tcp_in_object"):
        notes(grasp_widths=np.zeros(3))
    with pytest.raises(AssetError, match="display_pose"):
        notes(display_pose=2)
    with pytest.raises(AssetError, match="surface_points"):
        notes(surface_points=np.full((8, 3), np.nan))
    path = tmp_path / "annotations.npz"
    np.savez(path, resting_poses=np.array([{"a": 1}], dtype=object))
    with pytest.raises(AssetError, match="can't read the annotations"):
        Annotations.load(path)


def test_unchanged_files_are_hashed_once(box_pack, monkeypatch):
    load_pack(box_pack)
    monkeypatch.setattr("hashlib.sha256", lambda: pytest.fail("read a file again"))
    load_pack(box_pack)
    path = box_pack / "box" / "visual_fast.glb"
    os.utime(path, ns=(1, 1))
    with pytest.raises(pytest.fail.Exception):
        load_pack(box_pack)
