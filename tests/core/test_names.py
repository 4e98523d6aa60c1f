"""Names that may become parts of paths."""

import pytest

from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.names import FileName, check_name, is_name
from robocas_ms3.core.strict import StrictModel, parse


@pytest.mark.parametrize("name", ["a", "link_0", "Left Tür 1", "a.b-c", "机器人", "x" * 200])
def test_plain_names_pass(tmp_path, name):
    assert check_name(name, AssetError, where="file") == name
    (tmp_path / name).mkdir()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".hidden", "a/b", "/a", "..\\a", "a\nb", "a\x00", "\x1b[31m", "\ud800", "ü" * 101, 5, None]
)
def test_others_are_refused(name):
    assert not is_name(name)
    with pytest.raises(AssetError) as raised:
        check_name(name, AssetError, where="file")
    assert raised.value.where == "file" and len(str(raised.value)) < 300


def test_a_declared_form_refuses_them_too():
    class Form(StrictModel):
        name: FileName

    assert parse(Form, {"name": "a"}, AssetError, where="file").name == "a"
    with pytest.raises(AssetError):
        parse(Form, {"name": "../a"}, AssetError, where="file")
