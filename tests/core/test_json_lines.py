"""JSON Lines files: appending, incomplete and damaged lines, rewriting."""

from dataclasses import dataclass, field

import pytest

from robocas_ms3.core.errors import DatasetError, RobocasError
from robocas_ms3.core.json_lines import JsonLinesFile


@dataclass(frozen=True)
class Try:
    seed: int
    seconds: float = 0.0
    words: dict[str, int | None] = field(default_factory=dict)


@pytest.fixture
def ledger(tmp_path) -> JsonLinesFile[Try]:
    return JsonLinesFile(tmp_path / "tries.jsonl", Try)


def test_appended_records_are_read_with_their_types(ledger):
    assert ledger.read() == ledger.read_lines() == []
    ledger.append([])
    assert not ledger.path.exists()
    ledger.append([Try(1), Try(2, 1.5, {"a": None})])
    ledger.append([Try(3, 2)], sync=True)
    assert ledger.read() == [Try(1), Try(2, 1.5, {"a": None}), Try(3, 2.0)]
    assert ledger.path.read_text().count("\n") == 3
    ledger.rewrite([Try(4)])
    assert ledger.read() == [Try(4)]


@pytest.mark.parametrize("kept", range(1, 14))
def test_an_incomplete_last_line_is_ignored_and_overwritten(ledger, kept):
    ledger.append([Try(1)])
    whole = ledger.path.read_bytes()
    ledger.path.write_bytes(whole + b'{"seed": 23}\n'[:kept])
    assert ledger.read() == [Try(1), *([Try(23)] if kept >= 12 else [])]
    ledger.append([Try(3)])
    assert ledger.read() == [Try(1), *([Try(23)] if kept >= 12 else []), Try(3)]
    assert all(line.problem is None for line in ledger.read_lines())


def test_damaged_lines_differ_from_an_incomplete_last_line(ledger):
    ledger.path.write_bytes(b'{"seed": 1, "new": 0}\n\n{"seed": "1"}\n[]\n\xff\n{"seed": 2}\n{"se')
    lines = ledger.read_lines()
    assert [(line.number, line.record, line.cut_off) for line in lines] == [
        (1, Try(1), False),
        (3, None, False),
        (4, None, False),
        (5, None, False),
        (6, Try(2), False),
        (7, None, True),
    ]
    error = ledger.make_line_error(lines[1], DatasetError, "no try")
    assert str(error) == (f"{ledger.path}:3: no try: invalid value for 'seed' (expected a whole number, found '1')")
    ledger.append([Try(3)])
    assert [line.number for line in ledger.read_lines() if line.record is None] == [3, 4, 5]
    assert ledger.read() == [Try(1), Try(2), Try(3)]


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999", "9" * 400 + ".5"])
def test_a_line_with_nan_or_infinity_is_damaged(tmp_path, number):
    ledger: JsonLinesFile[Try] = JsonLinesFile(tmp_path / "tries.jsonl", Try)
    ledger.path.write_text(f'{{"seed": 1, "seconds": {number}}}\n{{"seed": 2}}\n{{"seed": 3, "more": [{number}]}}\n')
    assert [line.record for line in ledger.read_lines()] == [None, Try(2), None]
    error = str(ledger.make_line_error(ledger.read_lines()[2], DatasetError, "no try"))
    assert error.startswith(f"{ledger.path}:3: no try: invalid JSON (found ")
    with pytest.raises(RobocasError):
        ledger.append([Try(4, float("nan"))])
    assert len(ledger.read_lines()) == 3


def test_lines_may_have_any_json_type(tmp_path):
    plain: JsonLinesFile[dict[str, int]] = JsonLinesFile(tmp_path / "plain.jsonl", dict[str, int])
    plain.append([{"a": 1}])
    assert plain.read() == [{"a": 1}]


def test_a_folder_instead_of_a_file_is_an_error(tmp_path):
    with pytest.raises(OSError, match="Is a directory"):
        JsonLinesFile(tmp_path, Try).read_lines()
