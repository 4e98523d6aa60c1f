import json
import shutil

import numpy as np
import pytest
import trimesh

from asset_tools.import_ycb import load_ycb_source, make_ycb_jobs, make_ycb_object_id
from robocas_ms3.core.errors import AssetError

SIZES = {
    "003_cracker_box": (0.06, 0.16, 0.21),
    "005_tomato_soup_can": (0.07, 0.07, 0.10),
    "072-a_toy_airplane": (0.1, 0.1, 0.05),
    "070-a_colored_wood_blocks": (0.026, 0.026, 0.026),
}


@pytest.fixture
def root(tmp_path):
    """A folder as ManiSkill lays it out, of boxes."""
    info = {}
    for name, size in SIZES.items():
        folder = tmp_path / "models" / name
        folder.mkdir(parents=True)
        box = trimesh.creation.box(size)
        box.export(folder / "textured.obj")
        box.export(folder / "collision.ply")
        half = (np.array(size) / 2).tolist()
        bbox = {"min": [-v for v in half], "max": half}
        info[name] = {"bbox": bbox, "scales": [1.0], "density": 1000}
    (tmp_path / "info_pick_v0.json").write_text(json.dumps(info))
    return tmp_path


def test_names_become_the_ids_of_graspnet_objects():
    assert make_ycb_object_id("005_tomato_soup_can") == "tomato_soup_can"
    assert make_ycb_object_id("072-a_toy_airplane") == "toy_airplane_a"
    assert make_ycb_object_id("065-c_cups") == "cups_c"


def test_an_object_that_is_also_in_graspnet(root):
    source = load_ycb_source(root, "005_tomato_soup_can")
    assert (source.id, source.graspnet_id, source.mass) == ("tomato_soup_can", 2, 0.349)
    assert (source.source, source.licence) == ("ycb", "CC BY 4.0")
    assert source.closed.volume == pytest.approx(0.07 * 0.07 * 0.10)
    assert not source.hollow


def test_objects_that_are_not_in_graspnet(root):
    box = load_ycb_source(root, "003_cracker_box")
    assert (box.id, box.name, box.graspnet_id, box.mass) == ("cracker_box", "cracker box", None, 0.411)
    block = load_ycb_source(
        root, "070-a_colored_wood_blocks"
    )  # not listed: 600 kg/m3 would be 0.0105 kg, which is raised
    assert block.mass == pytest.approx(0.03)


def test_the_scale_is_applied(root):
    info = json.loads((root / "info_pick_v0.json").read_text())
    before = make_ycb_jobs(root, ["003_cracker_box"])[0].content
    info["003_cracker_box"]["scales"] = [0.5]
    (root / "info_pick_v0.json").write_text(json.dumps(info))
    source = load_ycb_source(root, "003_cracker_box")
    assert source.mesh.extents == pytest.approx([0.03, 0.08, 0.105])
    assert source.closed.extents == pytest.approx([0.03, 0.08, 0.105])
    assert make_ycb_jobs(root, ["003_cracker_box"])[0].content != before


def test_missing_models_are_one_error(root, tmp_path, monkeypatch):
    with pytest.raises(AssetError) as caught:
        make_ycb_jobs(tmp_path / "nowhere")
    assert "mani_skill.utils.download_asset ycb" in caught.value.fix
    monkeypatch.setenv("MS_ASSET_DIR", str(tmp_path / "elsewhere"))
    with pytest.raises(AssetError) as caught:
        make_ycb_jobs()
    assert caught.value.where == tmp_path / "elsewhere/data/assets/mani_skill2_ycb"
    with pytest.raises(AssetError) as caught:
        make_ycb_jobs(root, ["008_bat", "007_gun", "003_cracker_box"])
    assert caught.value.found == "007_gun, 008_bat"
    shutil.rmtree(root / "models" / "003_cracker_box")
    for read in (lambda: make_ycb_jobs(root), lambda: load_ycb_source(root, "003_cracker_box")):
        with pytest.raises(AssetError, match="003_cracker_box"):
            read()


@pytest.mark.parametrize("scales", ["[]", '["x"]', "[0]", "[-1]", "null"])
def test_an_invalid_scale_affects_only_its_object(root, scales):
    (root / "info_pick_v0.json").write_text(f'{{"003_cracker_box": {{"scales": {scales}}}}}')
    (job,) = make_ycb_jobs(root)
    with pytest.raises(AssetError):
        job.make(root / "out")


@pytest.mark.parametrize("text", ["{", "[]", '{"003_cracker_box": 3}', '{"../..": {}}'])
def test_a_damaged_list_is_one_error(root, text):
    (root / "info_pick_v0.json").write_text(text)
    with pytest.raises(AssetError, match=r"info_pick_v0\.json"):
        make_ycb_jobs(root)
