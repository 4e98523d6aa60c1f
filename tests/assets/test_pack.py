import json
import os

import numpy as np
import pytest
from asset_entries import furniture_asset, object_asset
from pydantic import ValidationError

from robocas_ms3.assets.annotations import Annotations, compute_footprints
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.manifest import PackManifest
from robocas_ms3.assets.pack import find_packs, load_pack, sha256
from robocas_ms3.core.errors import AssetError

BOX = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.03, 0.03) for z in (-0.02, 0.02)])


def notes(**changes):
    upright, on_end = np.eye(4), np.eye(4)
    upright[2, 3] = 0.02
    on_end[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    on_end[2, 3] = 0.05
    values = {
        "resting_poses": np.stack([upright, on_end]),
        "footprints": compute_footprints([BOX], np.stack([upright, on_end])),
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
    assert "boxes" in find_packs()
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


def manifest_with(**changes):
    """A function that changes the asset in a pack's manifest."""

    def change(pack):
        data = json.loads((pack / "manifest.json").read_text())
        data["assets"][0].update(changes)
        (pack / "manifest.json").write_text(json.dumps(data))

    return change


def replace_in(name, old, new):
    def change(pack):
        text = (pack / name).read_text()
        assert old in text
        (pack / name).write_text(text.replace(old, new))

    return change


def add_unlisted(pack):
    (pack / "box" / "links").mkdir()
    (pack / "box" / "links" / "more.glb").write_text("glTF")


VERSION = '"schema_version":2,'


@pytest.mark.parametrize(
    ("damage", "where"),
    [
        (lambda pack: (pack / "box" / "hulls.obj").unlink(), "box/hulls.obj"),
        (lambda pack: (pack / "box" / "hulls.obj").write_text(""), "box/hulls.obj"),
        (replace_in("box/hulls.obj", "0.05", "0.06"), "box/hulls.obj"),
        (add_unlisted, "box/links/more.glb"),
        (lambda pack: (pack / "manifest.json").write_text("{"), "manifest.json"),
        (replace_in("manifest.json", VERSION, '"schema_version":1,'), "manifest.json"),
        (replace_in("manifest.json", VERSION, '"schema_version":"2",'), "manifest.json"),
        (replace_in("manifest.json", VERSION, ""), "manifest.json"),
        (replace_in("manifest.json", '"hulls.obj"', '"other.obj"'), "manifest.json"),
        (manifest_with(mass=-1), "manifest.json"),
        (manifest_with(mass="0.1"), "manifest.json"),
        (manifest_with(friction=float("inf")), "manifest.json"),
        (manifest_with(grasp_count=1.0), "manifest.json"),
        (manifest_with(extents=[0.1, -0.06, 0.04]), "manifest.json"),
        (manifest_with(inertia_wxyz=[1, 0.1, 0, 0]), "manifest.json"),
        (manifest_with(inertia=[1e-5, 1e-5, 2.1e-5]), "manifest.json"),
        *(
            (manifest_with(files={name: "0" * length}), "manifest.json")
            for name, length in (("hulls.obj", 63), ("Hulls.obj", 64), ("../hulls.obj", 64), ("/hulls.obj", 64))
        ),
    ],
)
def test_damaged_files_are_found_after_a_successful_load(box_pack, damage, where):
    (box_pack / "box" / ".DS_Store").write_text("hidden ones don't count")
    load_pack(box_pack)
    damage(box_pack)
    with pytest.raises(AssetError) as caught:
        load_pack(box_pack)
    assert str(caught.value.where).startswith(str(box_pack / where)) and "\n" not in str(caught.value)


JOINT = {"name": "j", "kind": "prismatic", "axis": (1, 0, 0), "limits": (0, 0.3), "friction": 0.1, "damping": 1.0}
SURFACE = {"link": "", "min_xy": (0, 0), "max_xy": (1, 1), "z": 0}
HANDLE = {"link": "door", "position": (0, 0, 0), "wxyz": (0.7, 0, 0, 0.7), "width": 0.02}


def link(name="door", parent="", inertia=(1, 1, 1), **joint):
    facts = {"mass": 1, "center_of_mass": (0, 0, 0), "inertia": inertia}
    return {"name": name, "parent": parent, "joint": JOINT | {"name": "hinge"} | joint} | facts


@pytest.mark.parametrize(
    "changes",
    [
        {"surfaces": {"top": SURFACE | {"link": "drawer"}}},
        {"surfaces": {"top": SURFACE | {"max_xy": (1, 0)}}},
        {"links": (link(parent="box"),)},
        {"links": (link(), link(name="slide"))},  # two joints of one name
        {"links": (link(), link())},
        {"links": (link(name="body"),)},  # what the fixed one is called
        {"links": (link(axis=(1, 1, 0)),)},
        {"links": (link(limits=(0.1, 0.3)),)},  # without 0, which is closed
        {"links": (link(limits=(0, 0)),)},
        {"links": (link(inertia=(0.5, 0.487, 1)),)},  # of no body
        {"finishes": {"wall": ()}},
        {"mass": 2.0},  # without inertia
        {"links": (link(),), "handles": {"a": HANDLE}},  # no unit quaternion
    ],
    ids=str,
)
def test_invalid_furniture_is_refused(changes):
    furniture_asset(surfaces={"top": SURFACE}, links=(link(inertia=(0.5, 0.497, 1)),))  # moments may be rounded
    with pytest.raises(ValidationError):
        furniture_asset(**changes)


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"grasp_widths": np.zeros(3)}, "grasps_tcp_in_object"),
        ({"display_pose": 2}, "display_pose"),
        ({"surface_points": np.full((8, 3), np.nan)}, "surface_points"),
    ],
)
def test_annotations_with_invalid_shapes_are_refused(changes, where):
    with pytest.raises(AssetError) as caught:
        notes(**changes)
    assert caught.value.where == where


def test_annotations_are_not_unpickled(tmp_path):
    path = tmp_path / "annotations.npz"
    np.savez(path, resting_poses=np.array([{"a": 1}], dtype=object))
    with pytest.raises(AssetError) as caught:
        Annotations.load(path)
    assert caught.value.where == path


def test_a_footprint_has_each_corner_once():
    slab = np.array([[x, y, z] for x, y in ((0.03, 0), (-0.02, 0.02), (-0.02, -0.02)) for z in (-0.01, 0.01)])
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # on its edge: a rectangle of 0.02 x 0.04
    found = notes(resting_poses=poses, footprints=compute_footprints([slab], poses))
    assert len(found.footprint(0)) == 3 and len(found.footprint(1)) == 4
    np.testing.assert_allclose(np.ptp(found.footprint(1), axis=0), [0.02, 0.04])


def test_unchanged_files_are_hashed_once(box_pack, monkeypatch):
    load_pack(box_pack)
    monkeypatch.setattr("hashlib.sha256", lambda: pytest.fail("read a file again"))
    load_pack(box_pack)
    path = box_pack / "box" / "visual_fast.glb"
    os.utime(path, ns=(1, 1))
    with pytest.raises(pytest.fail.Exception):
        load_pack(box_pack)
