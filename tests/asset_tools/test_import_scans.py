import numpy as np
import pytest
import trimesh

from asset_tools.import_scans import ImportSettings, estimate_mass, find_scans, object_id, scan_jobs
from asset_tools.pipeline import made_of, write_pack
from asset_tools.reading.model import read_model
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import AssetError


def write_box(folder, name, size=(4.0, 6.0, 10.0)):
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(size).export(folder / f"{name}.ply")


def test_names_become_ids():
    assert object_id("Alphabet Soup (v2)") == "alphabet_soup_v2"
    assert object_id("Käse") == "kase"
    assert object_id("可乐") != object_id("牛奶") and object_id("可乐").startswith("object_")


def test_ids_are_bounded_and_different():
    assert len(object_id("a" * 250)) < 100 and object_id("a" * 250) != object_id("a" * 251)
    assert object_id("../../x") == "x" and object_id("..").startswith("object_")
    assert object_id("scan\udcff") == "scan"  # a file name that is no UTF-8


def test_mass_is_estimated_from_volume_within_limits():
    assert estimate_mass(trimesh.creation.box([0.1, 0.1, 0.05])) == pytest.approx(0.3)  # 0.5 l at 600 kg/m3
    assert estimate_mass(trimesh.creation.box([0.01] * 3)) == 0.03
    assert estimate_mass(trimesh.creation.box([0.2] * 3)) == 0.8


def test_a_folder_of_scans_in_centimetres_becomes_a_pack(tmp_path):
    write_box(tmp_path / "scans" / "Blue Box", "textured")
    write_box(tmp_path / "scans", "small", (3.0, 3.0, 8.0))
    jobs = scan_jobs(tmp_path / "scans", ImportSettings(masses={"small": 0.2}))
    done = []
    write_pack(jobs, tmp_path / "mine", tmp_path / "kept", on_made=done.append)
    pack = load_pack(tmp_path / "mine")
    assert pack.name == "mine"
    assert [result.id for result in done] == ["blue_box", "small"]
    box = pack.objects["blue_box"]
    assert sorted(box.asset.extents) == pytest.approx([0.04, 0.06, 0.1], abs=1e-6)
    assert box.asset.name == "blue box"
    assert box.asset.quality.volume_iou == pytest.approx(1.0, abs=1e-3)
    assert box.asset.quality.rest_share >= 0.9 and box.asset.quality.grasps_held >= 0.8
    assert pack.objects["small"].asset.mass == 0.2
    assert len(box.annotations.resting_poses) == 6
    assert box.asset.grasp_count >= 50
    # nothing to do a second time, until a scan or what is said of it changes
    assert made_of(scan_jobs(tmp_path / "scans", ImportSettings(masses={"small": 0.2})), tmp_path / "mine")
    assert not made_of(scan_jobs(tmp_path / "scans", ImportSettings()), tmp_path / "mine")
    with pytest.raises(AssetError, match="scans that are not there.*found smal"):
        scan_jobs(tmp_path / "scans", ImportSettings(masses={"smal": 0.2}))


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
        write_pack(scan_jobs(tmp_path / "scans", settings), tmp_path / "pack", tmp_path / "kept")
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "pack").exists()
    assert not [path for path in tmp_path.rglob("*.tmp")]


def test_bad_scans_can_be_left_out(tmp_path):
    write_box(tmp_path / "scans", "good")
    (tmp_path / "scans" / "bad.ply").write_bytes(b"nonsense")
    jobs = scan_jobs(tmp_path / "scans", ImportSettings(units="cm"))
    results = write_pack(jobs, tmp_path / "pack", tmp_path / "kept", skip_bad=True)
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
    (tmp_path / "thing" / "a.obj").write_text(
        "mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
    )
    with pytest.raises(AssetError, match=r"lost\.png"):
        read_model(tmp_path / "thing" / "a.obj")
