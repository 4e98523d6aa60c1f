import numpy as np
import pytest
import trimesh

from asset_tools.decompose import decompose, few_vertices, volume_iou
from asset_tools.import_scans import ImportSettings, estimate_mass, find_scans, import_scans, object_id
from asset_tools.repair import close
from asset_tools.scan import load_scan, upright
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.errors import AssetError


def write_box(folder, name, size=(4.0, 6.0, 10.0)):
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(size).export(folder / f"{name}.ply")


def test_names_become_ids():
    assert object_id("Alphabet Soup (v2)") == "alphabet_soup_v2"
    assert object_id("Käse") == "kase"


def test_mass_is_estimated_from_volume_within_limits():
    assert estimate_mass(trimesh.creation.box([0.1, 0.1, 0.05])) == pytest.approx(0.3)  # 0.5 l at 600 kg/m3
    assert estimate_mass(trimesh.creation.box([0.01] * 3)) == 0.03
    assert estimate_mass(trimesh.creation.box([0.2] * 3)) == 0.8


def test_overlap_of_shifted_boxes_is_known():
    box = trimesh.creation.box([2.0, 1.0, 1.0])
    half_out = np.asarray(box.vertices) + [1.0, 0, 0]
    assert volume_iou(box, [np.asarray(box.vertices)]) == pytest.approx(1.0, abs=1e-6)
    assert volume_iou(box, [half_out]) == pytest.approx(1 / 3, abs=1e-6)


def test_few_vertices_keep_volume():
    ball = trimesh.creation.icosphere(subdivisions=4)
    kept = few_vertices(np.asarray(ball.vertices), 48)
    assert len(kept) == 48
    assert trimesh.convex.convex_hull(kept).volume == pytest.approx(ball.volume, rel=1e-6)


def test_a_box_is_one_hull_and_a_u_is_several():
    assert len(decompose(trimesh.creation.box([0.1, 0.05, 0.03])).hulls) == 1
    parts = [
        ([0.1, 0.02, 0.02], [0, 0, 0]),
        ([0.02, 0.02, 0.08], [-0.04, 0, 0.03]),
        ([0.02, 0.02, 0.08], [0.04, 0, 0.03]),
    ]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    letter = trimesh.boolean.union(boxes)
    found = decompose(letter)
    assert len(found.hulls) >= 3
    assert found.volume_iou > 0.9


def test_a_folder_of_scans_in_centimetres_becomes_a_pack(tmp_path):
    write_box(tmp_path / "scans" / "Blue Box", "textured")
    write_box(tmp_path / "scans", "small", (3.0, 3.0, 8.0))
    done = []
    import_scans(tmp_path / "scans", tmp_path / "mine", ImportSettings(), jobs=1, on_result=done.append)
    pack = load_pack(tmp_path / "mine")
    assert pack.name == "mine"
    assert [result.id for result in done] == ["blue_box", "small"]
    box = pack.objects["blue_box"]
    assert sorted(box.asset.extents) == pytest.approx([0.04, 0.06, 0.1], abs=1e-6)
    assert box.asset.name == "blue box"
    assert box.asset.volume_iou == pytest.approx(1.0, abs=1e-3)
    assert len(box.annotations.resting_poses) == 6
    assert box.asset.grasp_count >= 50


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "bad"),  # empty file
        (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nelement face 0\nend_header\n", "bad"),
        (
            trimesh.exchange.ply.export_ply(trimesh.Trimesh([[0, 0, 0], [5, 0, 0], [0, 8, 0]], [[0, 1, 2]])),
            "bad",
        ),  # a sheet
        (
            trimesh.exchange.ply.export_ply(trimesh.Trimesh(np.zeros((4, 3)), [[0, 1, 2], [1, 2, 3]], process=False)),
            "bad",
        ),
    ],
)
def test_a_bad_scan_is_one_line_that_names_it_and_leaves_nothing(tmp_path, content, words):
    write_box(tmp_path / "scans", "good")
    (tmp_path / "scans" / "bad.ply").write_bytes(content)
    settings = ImportSettings(units="cm")
    with pytest.raises(AssetError) as error:
        import_scans(tmp_path / "scans", tmp_path / "pack", settings, jobs=1)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scans"]


def test_bad_scans_can_be_left_out(tmp_path):
    write_box(tmp_path / "scans", "good")
    (tmp_path / "scans" / "bad.ply").write_bytes(b"nonsense")
    results = import_scans(tmp_path / "scans", tmp_path / "pack", ImportSettings(units="cm"), jobs=1, skip_bad=True)
    assert {result.id: result.asset is not None for result in results} == {"good": True, "bad": False}
    assert list(load_pack(tmp_path / "pack").objects) == ["good"]


def test_missing_folder_texture_and_mesh(tmp_path):
    with pytest.raises(AssetError, match="no such folder of scans"):
        find_scans(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(AssetError, match="no scans in this folder"):
        find_scans(tmp_path / "empty")
    (tmp_path / "thing").mkdir()
    (tmp_path / "thing" / "a.mtl").write_text("newmtl m\nmap_Kd lost.png\n")
    (tmp_path / "thing" / "a.obj").write_text("mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(AssetError, match=r"lost\.png"):
        load_scan(tmp_path / "thing" / "a.obj")


@pytest.mark.slow
def test_the_can_of_the_reference_material(shared_dir):
    """A round can whose scan is a thin shell: naively 85 s and 16 hulls."""
    import time

    scan = load_scan(shared_dir / "scans" / "hope" / "alphabet_soup")
    body = upright(scan, "y")
    body.apply_scale(0.01)
    start = time.process_time()
    solid = close(body).mesh
    found = decompose(solid)
    assert time.process_time() - start < 15
    assert solid.volume > 0.8 * body.convex_hull.volume  # a solid, not a shell
    assert found.volume_iou >= 0.9
