"""Tables of rows by name, filled by packages that are made here."""

import logging
import sys

import pytest

from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.extensions import Table, load


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Write a package with entry points of a group; other modules of it by name."""

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


def table() -> Table[int]:
    return Table("number", "a.group", int, {"one": 1})


def test_rows_are_the_builtin_ones_and_those_of_packages(package):
    package({"seven": "a_stranger:SEVEN"}, a_stranger="SEVEN = 7")
    numbers = table()
    assert dict(numbers) == {"one": 1, "seven": 7}
    assert (len(numbers), "eight" in numbers, numbers.find("seven")) == (2, False, 7)


def test_a_builtin_row_is_not_looked_for_elsewhere(package, caplog):
    package({"one": "a_stranger:ONE"}, a_stranger="raise SystemError")
    assert dict(table()) == {"one": 1}
    assert caplog.messages == ["a second number 'one', of a_stranger:ONE, is left out"]


def test_what_is_broken_is_an_error_for_who_asks_for_it_and_one_warning_for_others(package, caplog):
    package({"bad": "a_stranger:BAD", "word": "words:WORD"}, a_stranger="raise OSError('gone')", words="WORD = 'x'")
    numbers = table()
    with caplog.at_level(logging.WARNING):
        assert list(numbers) == list(numbers) == ["one"]
    assert caplog.messages == [
        "bad = a_stranger:BAD: this number can't be loaded (found OSError: gone). Mend or uninstall stranger.",
        "word = words:WORD: no number (expected a int, found str). Mend or uninstall stranger.",
    ]
    for _ in range(2):
        with pytest.raises(ExtensionError, match="OSError: gone"):
            numbers.find("bad")


def test_a_name_that_several_packages_have_is_nobodys(tmp_path, monkeypatch, caplog):
    for package in ("ours", "yours"):
        info = tmp_path / f"{package}-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1\n")
        points = f"[a.group]\nseven = numbers_of_two:{package.upper()}\nsix = numbers_of_two:SIX\n"
        (info / "entry_points.txt").write_text(points)
    (tmp_path / "numbers_of_two.py").write_text("OURS, YOURS, SIX = 7, 8, 6")
    monkeypatch.syspath_prepend(tmp_path)
    numbers = table()
    assert dict(numbers) == {"one": 1, "six": 6}  # the same twice is no other
    said = "seven: several packages have a number of this name (found ours, yours). Uninstall all but one."
    assert caplog.messages == [said]
    with pytest.raises(ExtensionError, match="several packages have a number of this name"):
        numbers.find("seven")


def test_an_unknown_name_gets_the_nearest_ones():
    with pytest.raises(ExtensionError) as error:
        table().find("onne", where="here")
    assert str(error.value) == "here: no such number (expected one of ['one'], found 'onne'). Did you mean one?"


def test_a_row_whose_module_asks_for_the_table_while_it_is_imported_comes_after(package):
    ask = "import test_extensions_table\nBEFORE = list(test_extensions_table.NUMBERS)\nSEVEN = 7"
    held = "from robocas_ms3.core.extensions import Table\nNUMBERS = Table('number', 'a.group', int, {'one': 1})"
    package({"seven": "a_stranger:SEVEN"}, a_stranger=ask, test_extensions_table=held)
    import a_stranger  # pyright: ignore[reportMissingImports]
    import test_extensions_table  # pyright: ignore[reportMissingImports]

    assert a_stranger.BEFORE == ["one"]
    assert list(test_extensions_table.NUMBERS) == ["one", "seven"]


def test_so_does_one_whose_package_is_imported_yet(package, tmp_path):
    """A row's own module may want what its package has not come to."""
    table_ = "from robocas_ms3.core.extensions import Table\nNUMBERS = Table('number', 'a.group', int, {'one': 1})"
    package({"seven": "a_package.row:SEVEN"}, test_extensions_table=table_)
    (tmp_path / "a_package").mkdir()
    (tmp_path / "a_package" / "__init__.py").write_text(
        "import test_extensions_table\nBEFORE = list(test_extensions_table.NUMBERS)\n"
        "UNFINISHED = test_extensions_table.NUMBERS.unfinished()\nNUMBER = 7"
    )
    (tmp_path / "a_package" / "row.py").write_text("from a_package import NUMBER as SEVEN")
    import a_package  # pyright: ignore[reportMissingImports]
    import test_extensions_table  # pyright: ignore[reportMissingImports]

    assert (a_package.BEFORE, a_package.UNFINISHED) == (["one"], ["a_package.row"])
    assert list(test_extensions_table.NUMBERS) == ["one", "seven"]
    assert test_extensions_table.NUMBERS.unfinished() == []


def test_objects_by_import_path():
    assert load("robocas_ms3.core.extensions:load") is load
    for path in ("robocas_ms3.core.extensions:nothing", "robocas_ms3.nothing:load", "robocas_ms3.core.extensions"):
        with pytest.raises(ExtensionError, match=f"{path}: no such object .expected package.module:name"):
            load(path)
