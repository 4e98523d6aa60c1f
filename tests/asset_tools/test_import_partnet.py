"""A little cabinet written out as PartNet would; then the six real models."""

from functools import cache

import numpy as np
import pytest
import trimesh

from asset_tools.partnet.annotation import BUNDLED_ANNOTATIONS, ModelAnnotation, find_annotation, load_annotation
from asset_tools.partnet.collision import split_slender_hull
from asset_tools.partnet.importer import make_partnet_jobs, read_partnet
from asset_tools.partnet.template import make_template
from asset_tools.pipeline import write_pack
from asset_tools.quality.furniture import examine_furniture
from asset_tools.quality.overlap import compute_max_overlap, make_convex_body
from robocas_ms3.assets.hulls import find_box
from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import AssetError

SIX = ("12038", "21473", "24931", "45855", "45949", "46166")

# y up, z out of the front; the drawer slides along z and was drawn 0.1 m open
URDF = """<robot name="x"><link name="base"/>
<link name="body"><visual name="board-1"><geometry><mesh filename="top.obj"/></geometry></visual></link>
<link name="tray"><visual name="drawer-2"><origin xyz="0 0 0"/><geometry><mesh filename="tray.obj"/></geometry></visual>
</link>
<joint name="fix" type="fixed"><origin rpy="1.570796326794897 0 -1.570796326794897"/>
<parent link="base"/><child link="body"/></joint>
<joint name="slide" type="prismatic"><origin xyz="0 0 0"/><axis xyz="0 0 1"/>
<parent link="body"/><child link="tray"/><limit lower="-0.1" upper="0.2"/></joint>
</robot>"""
NOTE = {"name": "chest", "category": "cabinet", "origin_lift": 0.0}


def boxes(*spans):
    """Boxes given as (low, high) in PartNet's frame."""
    return trimesh.util.concatenate([trimesh.creation.box(bounds=span) for span in spans])


@cache
def real(shared_dir, name):
    return read_partnet(shared_dir / "partnet_mobility" / name, find_annotation(name))


@pytest.fixture
def chest(tmp_path):
    folder = tmp_path / "chest"
    folder.mkdir()
    (folder / "mobility.urdf").write_text(URDF)
    top = boxes([(-0.3, 0.2, -0.2), (0.3, 0.22, 0.2)])
    tray = boxes(
        [(-0.2, 0.0, -0.1), (0.2, 0.02, 0.3)],
        [(-0.2, 0.02, -0.1), (-0.18, 0.1, 0.3)],
        [(0.18, 0.02, -0.1), (0.2, 0.1, 0.3)],
        [(-0.18, 0.02, -0.1), (0.18, 0.1, -0.08)],
        [(-0.18, 0.02, 0.28), (0.18, 0.1, 0.3)],
    )
    for name, mesh in (("top", top), ("tray", tray)):
        text = trimesh.exchange.obj.export_obj(mesh, include_normals=False, include_color=False)
        (folder / f"{name}.obj").write_text("mtllib paint.mtl\nusemtl red\n" + text)
    (folder / "paint.mtl").write_text("newmtl red\nKd 0.8 0.1 0.1\n")
    return folder


def overlap(link, others, share):
    """How deep a moving part reaches into others at a share of its range, m."""
    motion = joint_motion(link.joint, share * max(link.joint.limits, key=abs))
    return compute_max_overlap(
        [make_convex_body(piece).transform(motion) for piece in link.pieces],
        [make_convex_body(other) for other in others],
    )


def read(folder, **more):
    return read_partnet(folder, ModelAnnotation.model_validate(NOTE | more))


def test_the_frame_is_turned_and_the_drawer_shut(chest):
    source = read(chest)
    corners = np.concatenate(source.pieces)
    # PartNet's z, x, y are our x, y, z
    assert corners.min(axis=0) == pytest.approx([-0.2, -0.3, 0.2])
    assert corners.max(axis=0) == pytest.approx([0.2, 0.3, 0.22])
    (link,) = source.links
    assert (link.name, link.parent, link.joint.name, link.joint.kind) == ("tray", "", "slide", "prismatic")
    assert link.joint.axis == pytest.approx((1, 0, 0))
    assert link.joint.limits == pytest.approx((0, 0.3))
    assert np.concatenate(link.pieces)[:, 0].max() == pytest.approx(0.2)  # 0.3 as drawn, 0.1 open
    assert link.mesh.bounds[1] == pytest.approx([0.2, 0.2, 0.1])


def test_a_drawer_is_hollow(chest):
    (link,) = read(chest).links
    assert len(link.pieces) == 5
    inside = trimesh.creation.box(bounds=[(-0.1, -0.1, 0.03), (0.1, 0.1, 0.1)]).vertices
    for piece in link.pieces:
        assert not trimesh.convex.convex_hull(piece).contains(inside).any()


def test_a_hull_too_slender_for_a_gpu_is_halved_or_becomes_a_box():
    # a bar whose section is a triangle with sides of 3, 4 and 5 cm: 8 mm from its middle to the nearest face
    section = np.array([[0, 0, 0], [0, 0.03, 0], [0, 0, 0.04]])
    bars = {length: np.concatenate([section, section + [length, 0, 0]]) for length in (1.5, 1.6, 4.0)}
    assert [piece.tolist() for piece in split_slender_hull(bars[1.5])] == [bars[1.5].tolist()]
    halves = split_slender_hull(bars[1.6])
    assert [len(half) for half in halves] == [6, 6]
    assert sorted(half[:, 0].max() for half in halves) == pytest.approx([0.8, 1.6])
    (box,) = [find_box(piece) for piece in split_slender_hull(bars[4.0])]
    assert box is not None and 8 * np.prod(box.half_size) == pytest.approx(4.0 * 0.03 * 0.04)


def test_notes_change_joints(chest):
    joints = {"slide": {"mass": 2.5, "friction": 0.2, "damping": 3.0, "limits": [0, 0.25]}}
    (link,) = read(chest, joints=joints).links
    assert (link.mass, link.joint.friction, link.joint.damping, link.joint.limits) == (2.5, 0.2, 3.0, (0, 0.25))
    assert read(chest, joints={"slide": {"fixed": True}}).links == ()
    (link,) = read(chest, joints={"slide": {"closed": 0.0}}).links
    assert link.joint.limits == pytest.approx((-0.1, 0.2))


def test_a_part_that_cuts_into_the_body_is_trimmed(chest):
    # 5 mm of the drawer's sides reach into the board
    tall = boxes([(-0.2, 0.0, -0.1), (0.2, 0.02, 0.3)], [(-0.2, 0.02, -0.1), (-0.18, 0.205, 0.3)])
    (chest / "tray.obj").write_text(trimesh.exchange.obj.export_obj(tall, include_normals=False, include_color=False))
    source = read(chest)
    (link,) = source.links
    assert np.concatenate(link.pieces)[:, 2].max() == pytest.approx(0.2 - 0.0015)
    for share in (0.0, 0.3, 1.0):
        assert overlap(link, source.pieces, share) == 0


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"joints": {"swing": {}}}, ("unknown joint", "swing", "slide")),
        (
            {"handles": {"a": {"joint": "fix", "position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "width": 0.02}}},
            ("'a'", "unknown joint", "slide"),
        ),
        ({"surfaces": {"top": {"min_xy": [-0.5, 0], "max_xy": [0, 0.1], "z": 0.22}}}, ("'top'", "outside")),
        (
            {"surfaces": {"top": {"link": "lid", "min_xy": [0, 0], "max_xy": [0.1, 0.1], "z": 0.22}}},
            ("'top'", "unknown link", "tray"),
        ),
        ({"joints": {"slide": {"limits": [0.1, 0.2]}}}, ("slide", "closed")),
        ({"mass": 20.0}, ("moving parts", "under `joints`")),
    ],
)
def test_annotations_that_do_not_fit_the_model_are_named(chest, more, words):
    with pytest.raises(AssetError) as raised:
        read(chest, **more)
    assert all(word in str(raised.value) for word in words), raised.value


@pytest.mark.parametrize(
    "change", ["surface: {}", "surfaces: {top: {min_xy: [0, 0], max_xy: [0, 0.1], z: 0.2}}", "a: [b"]
)
def test_bad_annotations_are_named(tmp_path, change):
    (tmp_path / "7.yaml").write_text(f"name: a\ncategory: b\norigin_lift: 0\n{change}\n")
    with pytest.raises(AssetError) as raised:
        load_annotation(tmp_path / "7.yaml")
    assert "7.yaml" in str(raised.value.where) and "\n" not in str(raised.value)


def test_a_model_without_an_annotation(tmp_path):
    with pytest.raises(AssetError) as raised:
        find_annotation("8", tmp_path)
    assert "--template" in raised.value.fix


def test_the_users_annotation_has_priority(tmp_path):
    assert find_annotation("45855", tmp_path).name == "sliding door cabinet"
    (tmp_path / "45855.yaml").write_text("name: mine\ncategory: b\norigin_lift: 0\n")
    assert find_annotation("45855", tmp_path).name == "mine"
    assert {path.stem for path in BUNDLED_ANNOTATIONS.glob("*.yaml")} == set(SIX)


def test_a_model_becomes_a_pack_and_the_same_bytes_again(chest, tmp_path):
    notes = tmp_path / "notes"
    notes.mkdir()
    (notes / "chest.yaml").write_text("name: chest\ncategory: cabinet\norigin_lift: 0\n")
    packs = [tmp_path / "one" / "furniture", tmp_path / "two" / "furniture"]
    for number, out in enumerate(packs):
        write_pack(make_partnet_jobs([chest], notes), out, tmp_path / f"kept{number}")
    loaded = load_pack(packs[0]).furniture["chest"]
    assert examine_furniture(loaded).joints["slide"].works  # from the files as well
    asset = loaded.asset
    assert (asset.source, asset.quality.joints_open) == ("partnet", 1.0)
    assert asset.files == load_pack(packs[1]).furniture["chest"].asset.files
    before = make_partnet_jobs([chest], notes)[0].content
    (chest / "paint.mtl").write_text("newmtl red\nKd 0.1 0.8 0.1\n")
    assert make_partnet_jobs([chest], notes)[0].content != before
    (job,) = make_partnet_jobs([chest, chest], notes)
    assert job.id == "chest"


def test_the_sliding_door_is_where_robocas_v0_has_it(shared_dir):
    source = real(shared_dir, "45855")
    (door,) = source.links
    assert (door.name, door.joint.name, door.joint.axis) == ("link_0", "joint_0", (0, -1, 0))
    handle = next(iter(source.handles.values()))
    assert handle.position == pytest.approx((0.378, 0.672, 0.0), abs=0.002)  # RoboCAS-v0's (0.672, 0, 0.378), rotated
    bar = next(piece for piece in door.pieces if piece[:, 0].min() > 0.36)
    assert (np.abs(np.array(handle.position) - (bar.min(axis=0) + bar.max(axis=0)) / 2)[:2] < 0.002).all()
    corners = np.concatenate([*source.pieces, *door.pieces])
    assert source.origin_height == pytest.approx(-corners[:, 2].min(), abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", SIX)
def test_real_models_have_working_joints_and_surfaces(shared_dir, name):
    source = real(shared_dir, name)
    report = examine_furniture(source)
    assert {joint for joint, found in report.joints.items() if not found.works} == set()
    assert {surface for surface, found in report.surfaces.items() if not found.holds} == set()
    assert set(report.joints) == {link.joint.name for link in source.links}
    assert {handle.link for handle in source.handles.values()} == {link.name for link in source.links}
    corners = np.concatenate(source.pieces)
    assert source.origin_height == pytest.approx(-corners[:, 2].min(), abs=0.011)  # the refrigerator's floor is a sheet
    for pieces in [source.pieces, *(link.pieces for link in source.links)]:
        assert len(pieces) <= 40
    for link in source.links:
        others = source.pieces + [piece for other in source.links if other is not link for piece in other.pieces]
        for share in (0.0, 0.05, 0.25, 0.6, 1.0):
            assert overlap(link, others, share) == 0


def test_a_template_has_the_models_joints_and_is_a_valid_annotation(shared_dir, tmp_path):
    text = make_template(shared_dir / "partnet_mobility" / "45949")
    (tmp_path / "45949.yaml").write_text(text)
    note = find_annotation("45949", tmp_path)
    assert set(note.joints) == {"joint_0", "joint_1", "joint_2"} and len(note.handles) == 3
    assert text.count("prismatic") == 1 and note.surfaces["link_2"].link == "link_2"
