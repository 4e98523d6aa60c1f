"""Untrusted files are limited in size and depth before they are parsed."""

import os

import pytest

from robocas_ms3.core import documents
from robocas_ms3.core.documents import (
    JSON_DEPTH,
    YAML_DEPTH,
    DocumentError,
    decode_json,
    load_json,
    load_npy,
    load_yaml,
    open_npz,
    read_bytes,
    read_text,
)


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "file"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def laughs(levels: int, merged: bool = False) -> str:
    first = "a0: &a0 {k: ha}" if merged else "a0: &a0 [ha, ha, ha, ha, ha, ha, ha, ha, ha]"
    rows = [first]
    for level in range(1, levels):
        nine = ", ".join([f"*a{level - 1}"] * 9)
        rows.append(f"a{level}: &a{level} " + (f"{{<<: [{nine}]}}" if merged else f"[{nine}]"))
    return "\n".join(rows)


@pytest.mark.parametrize("merged", [False, True])
def test_yaml_with_aliases_for_a_billion_values_is_an_error(file, merged):
    with pytest.raises(DocumentError, match="more than 500000 values after expanding aliases"):
        load_yaml(file(laughs(9, merged)))
    few = load_yaml(file(laughs(3, merged)))
    assert few["a2"] == ({"k": "ha"} if merged else [[["ha"] * 9] * 9] * 9)


def test_yaml_nested_beyond_the_limit_is_an_error(file):
    load_yaml(file("[" * YAML_DEPTH + "]" * YAML_DEPTH))
    for depth in (YAML_DEPTH + 1, 100_000):
        with pytest.raises(DocumentError, match=f"nested more than {YAML_DEPTH} levels deep"):
            load_yaml(file("[" * depth + "]" * depth))


@pytest.mark.parametrize("depth", [JSON_DEPTH + 1, 100_000])
def test_json_nested_too_deeply_is_an_error(file, depth):
    with pytest.raises(DocumentError):
        load_json(file("[" * depth + "]" * depth))
    load_json(file("[" * JSON_DEPTH + "]" * JSON_DEPTH))


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
def test_json_with_nan_or_infinity_is_an_error(file, number):
    with pytest.raises(DocumentError, match="is not a finite number$"):
        load_json(file(f'{{"a": [1, {number}]}}'))
    assert load_json(file(f'["{number}", 1e300]')) == [number, 1e300]


@pytest.mark.parametrize("load", [load_json, load_yaml])
@pytest.mark.parametrize("number", [2**63, -(2**63), int("9" * 4300)])
def test_integers_over_64_bits_are_an_error(file, load, number):
    with pytest.raises(DocumentError):
        load(file(f'{{"a": [1, {number}]}}'))
    assert load(file(f"[{2**63 - 1}]")) == [2**63 - 1]


@pytest.mark.parametrize("number", ["1:" * 200_000 + "1", "1:" * 200_000 + "1.5", "9" * 5000])
def test_long_yaml_numbers_are_refused_at_once(file, number):
    with pytest.raises(DocumentError):
        load_yaml(file(f"a: {number}"))
    assert load_yaml(file("a: [1:30, 0x10, 1:30.5, .inf]")) == {"a": [90, 16, 90.5, float("inf")]}


@pytest.mark.parametrize("text", ['["\\ud800"]', '{"\\udfff": 1}', '"\\uD83Dx"', b'"\xed\xa0\x80"'])
def test_lone_surrogates_of_json_are_refused(file, text):
    with pytest.raises(DocumentError):
        load_json(file(text))
    with pytest.raises(DocumentError):
        decode_json(text)
    assert load_json(file('"\\ud83d\\ude00"')) == "\U0001f600"


@pytest.mark.parametrize(
    "load",
    [load_json, load_yaml, open_npz, load_npy, lambda path: read_bytes(path, 9), lambda path: read_text(path, 9)],
)
def test_only_regular_files_are_read(tmp_path, load):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        with pytest.raises(DocumentError):
            load(tmp_path / name)


@pytest.mark.parametrize(("load", "limit"), [(load_json, "JSON_LIMIT"), (load_yaml, "YAML_LIMIT")])
def test_a_file_over_the_size_limit_is_not_read_completely(file, monkeypatch, load, limit):
    monkeypatch.setattr(documents, limit, 2**20)
    assert load(file('"' + "a" * (2**20 - 2) + '"')) == "a" * (2**20 - 2)
    with pytest.raises(DocumentError, match="more than 1 MB"):
        load(file('"' + "a" * (2**20 - 1) + '"'))


@pytest.mark.parametrize("load", [load_json, load_yaml])
@pytest.mark.parametrize("text", [b"\xff\xfe{}", '{"a": ', "\x00"])
def test_invalid_syntax_gives_a_one_line_error(file, load, text):
    with pytest.raises(DocumentError) as error:
        load(file(text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("a: 1\nb: c: 2", "^line 2, column 5: mapping values are not allowed here$"),
        ("a: 1\na: 2", "^line 2, column 1: duplicate key 'a'$"),
        ("? [1]\n: 2", "unhashable key"),
        ("d: 2020-02-30", "day is out of range"),
    ],
)
def test_invalid_yaml_is_an_error(file, text, match):
    with pytest.raises(DocumentError, match=match):
        load_yaml(file(text))


def test_merged_keys_are_not_duplicates(file):
    text = "z: &z {k: 0}\na: &a {<<: *z, k: 1}\nb: {<<: *a, k: 2}"
    assert load_yaml(file(text)) == {"z": {"k": 0}, "a": {"k": 1}, "b": {"k": 2}}
