"""URDF models as people have them: primitives, scales, odd names, missing and hostile files."""

import os
import stat
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.exchange.obj import export_obj

from asset_tools.partnet.annotation import ModelAnnotation, find_annotation
from asset_tools.partnet.importer import make_partnet_jobs, read_partnet
from asset_tools.partnet.template import make_template
from asset_tools.pipeline import write_pack
from robocas_ms3.core.errors import AssetError

NOTE = {"name": "chest", "category": "cabinet", "origin_lift": 0.0}
BOX = '<geometry><box size="0.4 0.6 0.02"/></geometry>'
TRAY = '<geometry><box size="0.3 0.3 0.1"/></geometry>'
RANGE = '<limit lower="0" upper="0.2"/>'


def urdf(*, body=f"<visual>{BOX}</visual>", tray=f"<visual>{TRAY}</visual>", joint=RANGE, kind="prismatic", **more):
    """A board, and below it a drawer that slides along -x of the URDF, which is forward."""
    names = {"link": "tray", "name": "slide", "axis": "-1 0 0", "rest": ""} | more
    return f"""<robot name="x"><link name="corpus">{body}</link><link name="{names["link"]}">{tray}</link>
<joint name="{names["name"]}" type="{kind}"><origin xyz="0 0 -0.1"/><axis xyz="{names["axis"]}"/>
<parent link="corpus"/><child link="{names["link"]}"/>{joint}</joint>{names["rest"]}</robot>"""


@pytest.fixture
def folder(tmp_path):
    """A model's folder with a box of 10 cm as ``cube.obj``, red by ``paint.mtl``."""
    folder = tmp_path / "model"
    folder.mkdir()
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    text = export_obj(cube, include_normals=False, include_color=False)
    (folder / "cube.obj").write_text("mtllib paint.mtl\nusemtl red\n" + text)
    (folder / "paint.mtl").write_text("newmtl red\nKd 0.8 0.1 0.1\n")
    return folder


def read(folder, text, **more):
    (folder / "mobility.urdf").write_text(text, encoding="utf-8")
    return read_partnet(folder, ModelAnnotation.model_validate(NOTE | more))


def mesh(name, more=""):
    return f'<visual><geometry><mesh filename="{name}" {more}/></geometry></visual>'


def colors_of(body):
    image = np.asarray(body.visual.material.baseColorTexture)
    return {tuple(pixel) for pixel in image.reshape(-1, 3).tolist()}


def test_primitives_have_their_sizes_and_colours(folder):
    round_parts = (
        '<visual><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.05" length="0.3"/></geometry>'
        '<material name="blue"><color rgba="0 0 1 1"/></material></visual>'
        '<visual><origin xyz="0.5 0 0"/><geometry><sphere radius="0.04"/></geometry><material name="blue"/></visual>'
    )
    source = read(folder, urdf(body=f"<visual>{BOX}</visual>{round_parts}"))
    assert source.mesh.bounds == pytest.approx(np.array([[-0.54, -0.3, -0.05], [0.2, 0.3, 0.25]]), abs=1e-3)
    assert colors_of(source.mesh) == {(0, 0, 255), (178, 178, 178)}
    (link,) = source.links
    assert link.mesh.extents == pytest.approx([0.3, 0.3, 0.1])
    assert link.joint.axis == pytest.approx((1, 0, 0)) and link.joint.limits == (0, 0.2)
    assert source.repairs == ()


@pytest.mark.parametrize("scale", ["2 1 0.5", "-2 1 0.5"])
def test_the_scale_of_a_mesh_is_applied(folder, scale):
    (link,) = read(folder, urdf(tray=mesh("cube.obj", f'scale="{scale}"'))).links
    assert link.mesh.extents == pytest.approx([0.2, 0.1, 0.05])
    assert link.mesh.volume == pytest.approx(0.001)  # negative where the faces look inward


def test_a_model_in_millimetres_is_refused_until_its_scale_is_given(folder):
    big = urdf(
        body='<visual><geometry><box size="400 600 20"/></geometry></visual>', joint='<limit lower="0" upper="200"/>'
    )
    big = big.replace("0.3 0.3 0.1", "300 300 100")
    with pytest.raises(AssetError):
        read(folder, big)
    with pytest.raises(AssetError) as raised:
        read(folder, big, joints={"slide": {"fixed": True}})
    assert raised.value.where == "model" and "scale" in raised.value.fix
    source = read(folder, big, scale=0.001)
    assert source.mesh.extents == pytest.approx([0.4, 0.6, 0.02])
    assert source.links[0].joint.limits == pytest.approx((0, 0.2))


@pytest.mark.parametrize("name", ["package://anything/cube.obj", "package://model/cube.obj", "./x/../cube.obj"])
def test_paths_inside_the_model_are_found(folder, name):
    (link,) = read(folder, urdf(tray=mesh(name))).links
    assert link.mesh.extents == pytest.approx([0.1, 0.1, 0.1])


@pytest.mark.parametrize(
    "extra",
    [
        mesh("ghost.obj"),
        mesh("empty.obj"),
        mesh("line.obj"),
        "<visual><geometry><pyramid/></geometry></visual>",
        "<visual/>",
    ],
)
def test_an_unusable_shape_is_skipped_and_reported(folder, extra):
    (folder / "empty.obj").write_text("v 0 0 0\n")
    (folder / "line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    source = read(folder, urdf(tray=mesh("cube.obj") + extra))
    assert source.links[0].mesh.extents == pytest.approx([0.1, 0.1, 0.1])
    (repair,) = source.repairs
    assert "tray" in repair
    with pytest.raises(AssetError):  # most of the link is missing
        read(folder, urdf(tray=mesh("cube.obj") + extra + extra))


def test_collision_shapes_are_shown_where_there_are_no_others(folder):
    source = read(folder, urdf(tray=f"<collision>{TRAY}</collision>"))
    assert source.links[0].mesh.extents == pytest.approx([0.3, 0.3, 0.1])
    assert len(source.repairs) == 1


def test_a_moving_link_without_a_mesh_can_be_fixed(folder):
    empty = f"""<link name="ghost"/><joint name="spin" type="revolute"><parent link="tray"/><child link="ghost"/>
    {RANGE}</joint>"""
    with pytest.raises(AssetError) as raised:
        read(folder, urdf(rest=empty))
    assert "fixed: true" in raised.value.fix
    (link,) = read(folder, urdf(rest=empty), joints={"spin": {"fixed": True}}).links
    assert link.name == "tray"
    (folder / "model.yaml").write_text(make_template(folder))  # the template holds it
    assert find_annotation("model", folder).joints["spin"].fixed


ENDLESS = [("prismatic", "-inf", "inf"), ("revolute", 0, "inf"), ("revolute", 0, 0), ("prismatic",), ("continuous",)]


@pytest.mark.parametrize(("kind", "limits"), [(kind, limits) for kind, *limits in ENDLESS])
def test_a_joint_without_a_finite_range_is_fixed_and_reported(folder, kind, limits):
    text = urdf(kind=kind, joint='<limit lower="{}" upper="{}"/>'.format(*limits) if limits else "")
    source = read(folder, text)
    assert source.links == () and "slide" in source.repairs[0]
    (link,) = read(folder, text, joints={"slide": {"limits": [0, 0.1]}}).links
    assert link.joint.limits == (0, 0.1)


UNUSABLE = [
    *({"joint": f'<limit lower="0" upper="{upper}"/>'} for upper in ("1e308", "nan", "wide", "-1")),
    *({"kind": kind, "joint": ""} for kind in ("planar", "floating")),
    *({"kind": "revolute", "axis": axis} for axis in ("None None None", "0 0 0", "1e308 0 0")),
]


@pytest.mark.parametrize("joint", UNUSABLE)
def test_an_invalid_joint_is_an_error_unless_it_is_fixed(folder, joint):
    text = urdf(**joint)
    with pytest.raises(AssetError) as raised:
        read(folder, text)
    assert "mobility.urdf" in str(raised.value.where)
    assert read(folder, text, joints={"slide": {"fixed": True}}).links == ()


@pytest.mark.parametrize("name", ["../../evil", "/tmp/evil", "a\\b", "..", "", "x" * 300, "a\nb"])
@pytest.mark.parametrize("element", ["link", "name"])
def test_names_with_paths_are_refused_before_writing(folder, tmp_path, name, element):
    (folder / "mobility.urdf").write_text(urdf(**{element: name}).replace("\n", "&#10;"), encoding="utf-8")
    (tmp_path / "model.yaml").write_text("name: chest\ncategory: cabinet\norigin_lift: 0\n")
    before = sorted(tmp_path.rglob("*"))
    (job,) = make_partnet_jobs([folder], tmp_path)
    with pytest.raises(AssetError) as raised:
        job.make(tmp_path / "out")
    assert "mobility.urdf" in str(raised.value.where)
    assert sorted(tmp_path.rglob("*")) == before


def test_other_names_become_names_of_a_pack(folder):
    text = urdf(link="Left Tür 1", name="Slide-1", rest='<link name="body"/>' + JOINT.format("corpus", "body"))
    more = {
        "surfaces": {
            "top": {"min_xy": [-0.1, -0.1], "max_xy": [0.1, 0.1], "z": 0.01},
            "in": {"link": "Left Tür 1", "min_xy": [-0.1, -0.1], "max_xy": [0.1, 0.1], "z": -0.05},
        },
        "handles": {"a": {"joint": "Slide-1", "position": [0.2, 0, 0], "wxyz": [1, 0, 0, 0], "width": 0.02}},
    }
    source = read(folder, text, **more)
    (link,) = source.links
    assert (link.name, link.joint.name) == ("left_tur_1", "slide_1")
    assert source.surfaces["in"].link == source.handles["a"].link == "left_tur_1"
    assert source.surfaces["top"].link == ""
    (folder / "model.yaml").write_text(make_template(folder), encoding="utf-8")
    assert find_annotation("model", folder).surfaces["left_tur_1"].link == "Left Tür 1"
    (clash,) = read(folder, urdf(link="body")).links  # what the fixed body is called in a pack
    assert clash.name != "body"


JOINT = '<joint name="fixed" type="fixed"><parent link="{}"/><child link="{}"/></joint>'


@pytest.mark.parametrize(
    "text",
    [
        '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>',
        '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot>&a;</robot>',
        '<?xml version="1.0" encoding="shift-jis"?><robot/>',
        '<?xml version="1.0" encoding="none"?><robot/>',
        "<sdf/>",
        "<robot/>",
        urdf(rest='<link name="tray"/>'),
        urdf(rest='<link name="a"/>'),
        urdf(
            rest='<link name="a"/><link name="b"/>' + JOINT.format("a", "b") + JOINT.format("b", "a").replace("fi", "")
        ),
        urdf(body='<visual><geometry><box size="1 1"/></geometry></visual>'),
        urdf(body='<visual><geometry><box size="1 1 -1"/></geometry></visual>'),
        urdf(body="<visual><geometry><sphere/></geometry></visual>"),
        urdf(body=f'<visual><origin xyz="1e308 0 0"/>{BOX}</visual>'),
        urdf(body=f'<visual><origin rpy="0 nan 0"/>{BOX}</visual>'),
        urdf(body=f'<visual>{BOX}<material name="a"><color rgba="red"/></material></visual>'),
        urdf(body=mesh("cube.obj", 'scale="0 1 1"')),
        urdf(body=mesh("cube.stl")),
        urdf(body=mesh("cube.glb")),
        urdf(body=""),
        f"<robot>{' ' * (17 * 2**20)}</robot>",
    ],
)
def test_an_invalid_model_is_one_error(folder, text):
    for name in ("cube.stl", "cube.glb"):
        (folder / name).write_bytes(b"solid\n")
    with pytest.raises(AssetError):
        read(folder, text)


@pytest.mark.parametrize(
    ("tray", "mtl"),
    [
        (mesh("../secret.obj"), ""),
        (mesh("cube.obj"), "newmtl red\nmap_Kd ../secret.png\n"),
    ],
)
def test_paths_out_of_the_model_are_refused(folder, tmp_path, tray, mtl):
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    (tmp_path / "secret.obj").write_text((folder / "cube.obj").read_text())
    (folder / "paint.mtl").write_text(mtl)
    with pytest.raises(AssetError) as raised:
        read(folder, urdf(tray=tray))
    assert "secret" in str(raised.value.where)


def test_a_bad_model_does_not_stop_the_others(folder, tmp_path):
    (folder / "mobility.urdf").write_text(urdf())
    os.mknod(folder / "other.png", stat.S_IFSOCK | 0o600)  # which the model does not name; a pipe would never end
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "mobility.urdf").write_text("<robot>")
    (tmp_path / "other" / "model").mkdir(parents=True)
    file = tmp_path / "readme.txt"
    file.write_text("no folder")
    for name in ("model", "bad", "readme.txt"):
        (tmp_path / f"{name}.yaml").write_text("name: chest\ncategory: cabinet\norigin_lift: 0\n")
    models = [folder, bad, tmp_path / "nothing", file, tmp_path / "other" / "model"]
    jobs = make_partnet_jobs(models, tmp_path)
    assert len({job.id for job in jobs}) == len(jobs) == len(models)
    results = write_pack(jobs, tmp_path / "pack", tmp_path / "kept", skip_errors=True)
    assert sorted(made.id for made in results if made.asset) == ["model"]


OBJ = (
    "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nvt 0 0\nvt 1 0\nvt 0 1\n{}f 1/1 2/2 3/3\nf 1/1 2/2 4/3\nf 2/1 3/2 4/3\n"
)


RED, WOOD, BLUE, GREY = "newmtl red\n", (10, 150, 20), (0, 0, 255), (178, 178, 178)
PAINT = "mtllib paint.mtl\nusemtl red\n"
BLUE_WOOD = RED + "Kd 0 0 1\nmap_Kd wood.png\n"


@pytest.mark.parametrize(
    ("head", "mtl", "u", "color", "reported"),
    [
        ("mtllib paint.mtl\nusemtl  RED\n", "NEWMTL red\nMAP_KD WOOD.png\n", 1, WOOD, True),
        ("mtllib paint.mtl\n", RED + "map_Kd wood.png\n", 1, WOOD, False),
        ("mtllib gone.mtl\nusemtl red\n", f"newmtl blue\nmap_Kd gone.png\n{RED}map_Kd wood.png\n", 1, WOOD, True),
        (PAINT, RED + "Kd 0 0 1\nmap_Kd gone.png\n", 1, BLUE, True),
        (PAINT, "", 1, GREY, True),
        *((PAINT, BLUE_WOOD, u, BLUE, True) for u in ("1e300", "nan", "20000")),  # they repeat without bounds
    ],
)
def test_textures_are_found_or_their_loss_is_reported(folder, head, mtl, u, color, reported):
    Image.new("RGB", (4, 4), WOOD).save(folder / "wood.png")
    (folder / "paint.mtl").unlink()
    for name in ("paint.mtl", "cube.mtl") if mtl else ():
        (folder / name).write_text(mtl)
    (folder / "cube.obj").write_text(OBJ.format(head).replace("vt 1 0", f"vt {u} 0"))
    source = read(folder, urdf(tray=mesh("cube.obj")))
    assert colors_of(source.links[0].mesh) == {color} and bool(source.repairs) == reported


def test_the_scale_of_an_annotation_is_that_of_the_whole_model(folder):
    text = urdf(tray=mesh("cube.obj"), joint='<limit lower="-0.1" upper="0.2"/>')
    (whole,), (half,) = read(folder, text).links, read(folder, text, scale=0.5).links
    assert half.mesh.bounds == pytest.approx(whole.mesh.bounds / 2)
    assert half.joint.origin == pytest.approx(np.array(whole.joint.origin) / 2)
    assert half.joint.limits == pytest.approx((0, 0.15))
    (turned,) = read(folder, urdf(kind="revolute", joint='<limit lower="0" upper="1.5"/>'), scale=0.5).links
    assert turned.joint.limits == pytest.approx((0, 1.5))


def test_stl_meshes_have_the_colour_of_the_urdf(folder):
    trimesh.creation.box((0.1, 0.1, 0.1)).export(folder / "cube.STL", file_type="stl")
    tray = mesh("cube.STL").replace("</visual>", '<material name="a"><color rgba="0 1 0 1"/></material></visual>')
    (link,) = read(folder, urdf(tray=tray)).links
    assert link.mesh.extents == pytest.approx([0.1, 0.1, 0.1]) and colors_of(link.mesh) == {(0, 255, 0)}


def test_mimic_joints_move_independently(folder):
    source = read(folder, urdf(joint=RANGE + '<mimic joint="other"/>'))
    assert len(source.links) == len(source.repairs) == 1


@pytest.mark.parametrize("name", ["../x", "A", "", "a\n"])
def test_invalid_folder_names_are_refused(folder, name):
    source = read(folder, urdf())
    for change in (
        lambda: replace(source, id=name),
        lambda: replace(source.links[0], name=name),
        lambda: replace(source, finishes={"wall": {name: source.mesh}}),
    ):
        with pytest.raises(AssetError):
            change()


def test_a_linked_folder_is_read_as_the_model(folder, tmp_path):
    (folder / "mobility.urdf").write_text(urdf(tray=mesh("cube.obj")))
    (tmp_path / "alias").symlink_to(folder)
    assert read_partnet(tmp_path / "alias", ModelAnnotation.model_validate(NOTE)).id == "model"
