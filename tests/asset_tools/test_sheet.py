import numpy as np
import pytest
import trimesh
from PIL import Image

from asset_tools.build import write_visuals
from asset_tools.sheet import (
    CAPTION,
    CELLS,
    GAP,
    LABEL,
    LARGE,
    contact_sheet,
)
from asset_tools.studio import PAPER, Body, Studio, box_faces
from robocas_ms3.assets.annotations import Annotations, footprints
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.manifest import FurnitureAsset, FurnitureQuality, ObjectAsset, ObjectQuality, PackManifest
from robocas_ms3.assets.pack import LINKS, load_pack, sha256

SIZE = np.array([0.04, 0.10, 0.06])
BASE = {"source": "test", "licence": "MIT", "attribution": "none", "category": "test"}


def write_body(folder, size, at, colour):
    folder.mkdir(parents=True)
    box = trimesh.creation.box(size)
    box.apply_translation(at)
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.full((len(box.vertices), 2), 0.5),
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (8, 8), colour)),
    )
    write_visuals(box, folder)
    write_hulls(folder / "hulls.obj", [np.asarray(box.vertices)])


def hashes(folder):
    return {path.relative_to(folder).as_posix(): sha256(path) for path in folder.rglob("*") if path.is_file()}


def box_asset(folder):
    """A red box with two resting poses and one grasp."""
    write_body(folder, SIZE, (0, 0, 0), (200, 0, 0))
    upright, grasp = np.tile(np.eye(4), (2, 1, 1))
    upright[2, 3] = 0.03
    on_its_side = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0.02], [0, 0, 0, 1.0]])
    grasp[:3, :3] = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # from above, closing along x
    poses = np.array([upright, on_its_side])
    corners = trimesh.creation.box(SIZE).vertices
    Annotations(
        resting_poses=poses,
        footprints=footprints([np.asarray(corners)], poses),
        resting_probabilities=np.array([0.25, 0.75]),
        display_pose=0,
        grasps_tcp_in_object=grasp[None],
        grasp_widths=np.array([0.04]),
        grasp_qualities=np.array([0.1]),
        surface_points=corners,
        surface_normals=np.eye(3)[np.zeros(8, int)],
    ).save(folder / "annotations.npz")
    quality = ObjectQuality(
        compact=True,
        hull_count=1,
        hull_vertices=8,
        volume_iou=1,
        surface_p95=0,
        rest_share=1,
        rest_time=0.3,
        penetration=0,
        jitter=0,
        grasps_tried=1,
        grasps_held=1,
    )
    inertia = tuple(float(v) for v in 0.1 / 12 * (SIZE @ SIZE - SIZE**2))
    return ObjectAsset(
        id=folder.name,
        name="box",
        extents=tuple(SIZE.tolist()),
        files=hashes(folder),
        mass=0.1,
        center_of_mass=(0, 0, 0),
        inertia=inertia,
        grasp_count=1,
        quality=quality,
        **BASE,
    )


def drawer_asset(folder):
    """A blue chest whose green drawer comes out to +x, with a handle and a surface in it."""
    write_body(folder, (0.4, 0.4, 0.2), (0, 0, 0), (0, 0, 200))
    write_body(folder / LINKS / "drawer", (0.36, 0.36, 0.1), (0, 0, 0), (0, 180, 0))
    joint = {"name": "slide", "kind": "prismatic", "axis": (1, 0, 0), "limits": (0, 0.3), "friction": 0, "damping": 1}
    link = {"name": "drawer", "joint": joint, "mass": 1, "center_of_mass": (0, 0, 0), "inertia": (0.1, 0.1, 0.1)}
    surface = {"link": "drawer", "min_xy": (0.0, -0.15), "max_xy": (0.18, 0.15), "z": 0.05, "headroom": 0.1}
    handle = {"link": "drawer", "position": (0.2, 0, 0), "wxyz": (0, 0.7071, 0, -0.7071), "width": 0.02}
    return FurnitureAsset.model_validate(
        BASE
        | {
            "id": folder.name,
            "name": "chest",
            "extents": (0.4, 0.4, 0.2),
            "files": hashes(folder),
            "links": [link],
            "handles": {"drawer": handle},
            "surfaces": {"drawer": surface},
            "quality": FurnitureQuality(hull_count=2, hull_vertices=8),
        }
    )


@pytest.fixture(scope="module")
def studio(needs_renderer):
    """Kept for all tests: as long as one is alive, others start at once."""
    return Studio(64)


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    root = tmp_path_factory.mktemp("sheet") / "pack"
    assets = [box_asset(root / "red_box"), drawer_asset(root / "chest")]
    (root / "manifest.json").write_text(PackManifest(name="pack", assets=assets).model_dump_json())
    return load_pack(root)


def share(picture, channel):
    """Share of the picture in which a colour channel stands out."""
    values = np.asarray(picture).astype(int)
    others = np.delete(values, channel, axis=2).max(axis=2)
    return float((values[..., channel] > others + 40).mean())


@pytest.mark.slow
def test_a_sheet_shows_every_asset(pack, tmp_path, studio):
    contact_sheet(pack, tmp_path / "new" / "sheet.png")
    sheet = Image.open(tmp_path / "new" / "sheet.png")
    width, height = CELLS * LARGE, CAPTION + LARGE + LABEL
    assert sheet.size == (2 * width + 3 * GAP, height + 2 * GAP)

    def cell(asset, i):
        left, top = GAP + asset * (width + GAP) + i * LARGE, GAP + CAPTION
        return sheet.crop((left, top, left + LARGE, top + LARGE))

    for i in (0, 1, 3, 4):  # from two sides, at rest, in a gripper
        assert share(cell(0, i), 0) > 0.05
    middle = LARGE // 2
    assert cell(0, 0).getpixel((middle, middle))[1] < 60  # the box is all red
    assert cell(0, 2).getpixel((middle, middle))[1] > 100  # hulls have colours of their own
    assert share(cell(0, 4), 1) > 0.005  # a gripper that needs little friction is green
    shut, opened = share(cell(1, 0), 1), share(cell(1, 1), 1)
    assert shut < 0.02 < opened  # the drawer is seen only when it is out
    caption = np.asarray(sheet.crop((GAP, GAP, GAP + width, GAP + CAPTION)))
    assert (caption < 90).any()


@pytest.mark.slow
def test_the_camera_looks_from_where_it_is_told(studio):
    # a red and a blue cube, side by side along y: from +x red, which stands at +y, is on the right
    cubes = [
        Body(faces.reshape(-1, 3), faces=faces, colour=colour)
        for faces, colour in (
            (box_faces((-0.5, 1, -0.5), (0.5, 2, 0.5)), (0.9, 0.05, 0.05)),
            (box_faces((-0.5, -2, -0.5), (0.5, -1, 0.5)), (0.05, 0.05, 0.9)),
        )
    ]
    picture = studio.picture(cubes, 0, 0)
    left, right = picture.crop((0, 0, 32, 64)), picture.crop((32, 0, 64, 64))
    assert share(right, 0) == pytest.approx(0.11, abs=0.02)  # 15 x 15 of 32 x 64 pixels, see below
    assert share(left, 2) == pytest.approx(0.11, abs=0.02)
    assert share(left, 0) == share(right, 2) == 0
    assert picture.getpixel((32, 2)) == PAPER
    # 4 m and a margin of 6 % across 64 pixels, so that a cube of 1 m is 15 pixels high
    rows = np.asarray(right)[:, 20, 2] < 100
    assert rows.sum() == pytest.approx(15, abs=2)
