"""What is read: regular files of bounded size below the imported folder, in bounded time and memory."""

import unicodedata

import pytest
from models import RED, image_file, shown_colors, write_obj

from asset_tools.inspection import ModelSource, inspect_models
from asset_tools.readers.files import ModelFiles, read_file
from asset_tools.readers.limits import limit_time_and_memory
from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError


def test_a_path_upwards_within_the_imported_folder(tmp_path):
    image_file(tmp_path / "shared" / "skin.png")
    path = write_obj(tmp_path / "mug", color=None, mtl="newmtl skin\nmap_Kd ../shared/skin.png\n")
    assert tmp_path / "shared" / "skin.png" in read_model(path, tmp_path).files
    with pytest.raises(AssetError):
        read_model(path)  # alone, its own folder is the imported one


def test_a_name_that_leads_outside_is_searched_below_the_model(tmp_path):
    image_file(tmp_path / "maps" / "skin.png")
    files = ModelFiles(tmp_path, tmp_path)
    for name in ("maps\\skin.png", "../../skin.png", "/etc/skin.png", "C:\\me\\skin.png", "file:///me/skin.png"):
        assert files.find(name, tmp_path) == tmp_path / "maps" / "skin.png"
    assert files.find("nul\0.png", tmp_path) is None
    with pytest.raises(AssetError):
        read_file(tmp_path / "lost", tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_names_with_accents(tmp_path, encoding):
    path = write_obj(tmp_path / "Öl", "Flasche", mtl=None, color=None, head="mtllib matériau.mtl", use="usemtl für Öl")
    path.write_bytes(path.read_text().encode(encoding))
    (tmp_path / "Öl" / "matériau.mtl").write_bytes("newmtl für Öl\nmap_Kd étiquette n° 1.png\n".encode(encoding))
    image_file(tmp_path / "Öl" / unicodedata.normalize("NFD", "étiquette n° 1.png"))
    assert (shown_colors(read_model(path).mesh) == RED).all()


def test_reading_is_bounded_in_memory():
    with pytest.raises(AssetError) as caught, limit_time_and_memory("mug"):
        bytearray(5 * 2**30)
    assert caught.value.where == "mug"


def test_reading_is_bounded_in_time(monkeypatch):
    monkeypatch.setattr("asset_tools.readers.limits.MAX_SECONDS", 0.05)
    with pytest.raises(AssetError), limit_time_and_memory("mug"):
        while True:
            pass
    with pytest.raises(AssetError), limit_time_and_memory("mug"):
        try:
            while True:
                pass
        except BaseException as error:
            raise TypeError("as native code says it") from error


def test_a_folder_of_links_to_models_elsewhere(tmp_path):
    """People keep datasets on another disk; what they link is theirs to read."""
    write_obj(tmp_path / "disk" / "mug")
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "mug").symlink_to(tmp_path / "disk" / "mug")
    assert len(read_model(tmp_path / "scans" / "mug", tmp_path / "scans").files) == 3


def test_one_model_that_cannot_be_read_does_not_end_the_inspection(tmp_path):
    write_obj(tmp_path / "good")
    write_obj(tmp_path / "bad").write_text("v nonsense")
    found = inspect_models({name: ModelSource((tmp_path / name,), tmp_path) for name in ("good", "bad")})
    assert found["good"].longest == pytest.approx(0.1) and found["good"].error is None
    assert isinstance(found["bad"].error, AssetError)
