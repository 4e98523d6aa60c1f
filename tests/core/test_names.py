"""Names that may become parts of paths."""

import pytest

from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.strict import FileName, StrictModel, check_name, parse


class Form(StrictModel):
    name: FileName


@pytest.mark.parametrize("name", ["a", "link_0", "Left Tür 1", "a.b-c", "机器人", "x" * 200])
def test_plain_names_pass(tmp_path, name):
    assert check_name(name, AssetError, where="file") == name
    (tmp_path / name).mkdir()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".hidden", "a/b", "/a", "..\\a", "a\nb", "a\x00", "\x1b[31m", "\ud800", "ü" * 101]
)
def test_others_are_refused(name):
    with pytest.raises(AssetError) as raised:
        check_name(name, AssetError, where="file")
    assert raised.value.where == "file" and len(str(raised.value)) < 300
    with pytest.raises(AssetError):
        parse(Form, {"name": name}, AssetError, where="file")
