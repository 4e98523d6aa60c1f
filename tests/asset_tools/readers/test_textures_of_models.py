"""A file that a model names is read in every format, if it is there and below the imported folder."""

import pytest
from models import (
    RED,
    TEXTURE,
    image_file,
    shown_colors,
    write_dae,
    write_glb,
    write_gltf,
    write_library,
    write_mtl,
    write_ply,
)

from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError

TEXTURED = {"obj": write_mtl, "dae": write_dae, "ply": write_ply, "glb": write_glb}


@pytest.mark.parametrize("write", TEXTURED.values(), ids=TEXTURED)
def test_a_texture_is_shown(tmp_path, write):
    image_file(tmp_path / "my skin.png")
    model = read_model(write(tmp_path, "my skin.png"))
    assert (shown_colors(model.mesh) == RED).all() and tmp_path / "my skin.png" in model.files


@pytest.mark.parametrize("write", [*TEXTURED.values(), write_library, write_gltf], ids=lambda write: write.__name__)
def test_a_missing_file_is_an_error_that_names_it(tmp_path, write):
    with pytest.raises(AssetError) as caught:
        read_model(write(tmp_path, "lost one"))
    assert str(caught.value.where).endswith("lost one")


@pytest.mark.parametrize("link", [False, True])
@pytest.mark.parametrize("write", [*TEXTURED.values(), write_library, write_gltf], ids=lambda write: write.__name__)
def test_nothing_outside_of_the_imported_folder_is_read(tmp_path, write, link):
    root, name = tmp_path / "scans", "../../secret.png"
    secret = image_file(tmp_path / "secret.png")
    if link:
        name = "inside.png"
        (root / "mug").mkdir(parents=True)
        (root / "mug" / name).symlink_to(secret)
    with pytest.raises(AssetError) as caught:
        read_model(write(root / "mug", name), root)
    assert name.rsplit("/", 1)[-1] in str(caught.value.where)


@pytest.mark.parametrize(
    ("diffuse", "image", "color"),
    [(TEXTURE, "file:///home/me/SKIN.png", RED), ("<color>0.2 0.6 1 1</color>", "skin.png", (51, 153, 255))],
)
def test_collada(tmp_path, diffuse, image, color):
    image_file(tmp_path / "skin.png")
    model = read_model(write_dae(tmp_path, image, diffuse))
    assert shown_colors(model.mesh).tolist() == [list(color)] and model.up == "z"


@pytest.mark.parametrize("comment", ["  TextureFile    {}  ", "texturefile {}", "TEXTUREFILE SKIN.PNG"])
def test_comments_of_ply(tmp_path, comment):
    image_file(tmp_path / "skin.png")
    assert (shown_colors(read_model(write_ply(tmp_path, "skin.png", comment)).mesh) == RED).all()
