"""Registries with entry points of packages that the tests create."""

import logging
import sys

import pytest

from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.extensions import Registry, import_object


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Write a package with entry points of a group, and further modules by name."""

    def write(points: dict[str, str], group: str = "a.group", **modules: str) -> None:
        info = tmp_path / "stranger-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1\n")
        lines = "".join(f"{name} = {value}\n" for name, value in points.items())
        (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")
        for name, text in modules.items():
            (tmp_path / f"{name}.py").write_text(text)
            monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.syspath_prepend(tmp_path)

    return write


def registry() -> Registry[int]:
    return Registry("number", "a.group", int, {"one": 1})


def test_a_registry_has_builtin_objects_and_entry_points(package):
    package({"seven": "a_stranger:SEVEN"}, a_stranger="SEVEN = 7")
    numbers = registry()
    assert dict(numbers) == {"one": 1, "seven": 7}
    assert (len(numbers), "eight" in numbers, numbers.find("seven")) == (2, False, 7)


def test_an_entry_point_can_not_replace_a_builtin_object(package, caplog):
    package({"one": "a_stranger:ONE"}, a_stranger="raise SystemError")
    assert dict(registry()) == {"one": 1}
    assert len(caplog.messages) == 1


def test_a_damaged_entry_point_raises_on_access_and_warns_once_on_iteration(package, caplog):
    package({"bad": "a_stranger:BAD", "word": "words:WORD"}, a_stranger="raise OSError('gone')", words="WORD = 'x'")
    numbers = registry()
    with caplog.at_level(logging.WARNING):
        assert list(numbers) == list(numbers) == ["one"]
    assert [message.partition(":")[0] for message in caplog.messages] == ["bad = a_stranger", "word = words"]
    for _ in range(2):
        with pytest.raises(ExtensionError, match="OSError: gone"):
            numbers.find("bad")


def test_a_name_defined_by_several_packages_is_an_error(tmp_path, monkeypatch, caplog):
    for package in ("ours", "yours"):
        info = tmp_path / f"{package}-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1\n")
        points = f"[a.group]\nseven = numbers_of_two:{package.upper()}\nsix = numbers_of_two:SIX\n"
        (info / "entry_points.txt").write_text(points)
    (tmp_path / "numbers_of_two.py").write_text("OURS, YOURS, SIX = 7, 8, 6")
    monkeypatch.syspath_prepend(tmp_path)
    numbers = registry()
    assert dict(numbers) == {"one": 1, "six": 6}  # both packages name the same object
    assert len(caplog.messages) == 1 and "ours, yours" in caplog.messages[0]
    with pytest.raises(ExtensionError, match="several packages define a number with this name"):
        numbers.find("seven")


def test_the_error_of_an_unknown_name_suggests_the_nearest_one():
    with pytest.raises(ExtensionError, match="Did you mean one") as error:
        registry().find("onne", where="here")
    assert error.value.where == "here"


def test_load_object_by_import_path():
    assert import_object("robocas_ms3.core.extensions:import_object") is import_object
    for path in ("robocas_ms3.core.extensions:nothing", "robocas_ms3.nothing:load", "robocas_ms3.core.extensions"):
        with pytest.raises(ExtensionError, match=f"{path}: cannot import this object .expected package.module:name"):
            import_object(path)
