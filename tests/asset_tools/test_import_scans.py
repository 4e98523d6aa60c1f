import numpy as np
import pytest
import trimesh

from asset_tools.import_scans import ImportSettings, estimate_mass, find_scans, make_object_id, make_scan_jobs
from asset_tools.pipeline import is_up_to_date, write_pack
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import AssetError


def write_box(folder, name, size=(4.0, 6.0, 10.0)):
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(size).export(folder / f"{name}.ply")


def test_names_become_ids_that_are_bounded_and_different():
    assert make_object_id("Alphabet Soup (v2)") == "alphabet_soup_v2"
    assert make_object_id("Käse") == "kase"
    assert make_object_id("可乐") != make_object_id("牛奶") and make_object_id("可乐").startswith("object_")
    assert len(make_object_id("a" * 250)) < 100 and make_object_id("a" * 250) != make_object_id("a" * 251)
    assert make_object_id("../../x") == "x" and make_object_id("..").startswith("object_")
    assert make_object_id("scan\udcff") == "scan"  # a file name that is no UTF-8


def test_mass_is_estimated_from_volume_within_limits():
    assert estimate_mass(trimesh.creation.box([0.1, 0.1, 0.05])) == pytest.approx(0.3)  # 0.5 l at 600 kg/m3
    assert estimate_mass(trimesh.creation.box([0.01] * 3)) == 0.03
    assert estimate_mass(trimesh.creation.box([0.2] * 3)) == 0.8


SHEET = trimesh.Trimesh([[0, 0, 0], [5, 0, 0], [0, 8, 0]], [[0, 1, 2]])
POINT = trimesh.Trimesh(np.zeros((4, 3)), [[0, 1, 2], [1, 2, 3]], process=False)
BAD = {
    "empty": b"",
    "nonsense": b"nonsense",
    "no_faces": b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nelement face 0\nend_header\n",
    "sheet": trimesh.exchange.ply.export_ply(SHEET),
    "point": trimesh.exchange.ply.export_ply(POINT),
}


def test_scans_in_centimetres_become_a_pack_without_the_bad_ones(tmp_path):
    scans = tmp_path / "scans"
    write_box(scans / "Blue Box", "textured")
    write_box(scans, "small", (3.0, 3.0, 8.0))
    for name, content in BAD.items():
        (scans / f"{name}.ply").write_bytes(content)
    settings = ImportSettings(masses={"small": 0.2})
    with pytest.raises(AssetError) as error:
        write_pack(make_scan_jobs(scans, settings), tmp_path / "mine", tmp_path / "kept")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "mine").exists() and not [path for path in tmp_path.rglob("*.tmp")]

    results = write_pack(make_scan_jobs(scans, settings), tmp_path / "mine", tmp_path / "kept", skip_errors=True)
    errors = {made.id: made.error for made in results if made.asset is None}
    assert errors.keys() == BAD.keys()
    assert all(name in message and "\n" not in message for name, message in errors.items())
    pack = load_pack(tmp_path / "mine")
    assert pack.name == "mine" and pack.objects.keys() == {"blue_box", "small"}
    box = pack.objects["blue_box"]
    assert sorted(box.asset.extents) == pytest.approx([0.04, 0.06, 0.1], abs=1e-6)
    assert box.asset.name == "blue box"
    assert box.asset.quality.volume_iou == pytest.approx(1.0, abs=1e-3)
    assert box.asset.quality.rest_share >= 0.9 and box.asset.quality.grasps_held >= 0.8
    assert pack.objects["small"].asset.mass == 0.2
    assert len(box.annotations.resting_poses) == 6
    assert box.asset.grasp_count >= 50
    # nothing to do a second time, until a scan or a setting changes
    assert is_up_to_date(make_scan_jobs(scans, settings), tmp_path / "mine", skip_errors=True)
    assert not is_up_to_date(make_scan_jobs(scans, ImportSettings()), tmp_path / "mine", skip_errors=True)
    with pytest.raises(AssetError, match="found smal"):
        make_scan_jobs(scans, ImportSettings(masses={"smal": 0.2}))


def test_a_folder_without_scans(tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("nowhere", "empty"):
        with pytest.raises(AssetError):
            find_scans(tmp_path / name)
