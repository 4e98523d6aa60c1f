import json
import re
import subprocess
import sys

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.text import (
    escape_controls,
    escape_markdown,
    format_count,
    format_error,
    format_object_name,
    format_ranges,
    one_line,
)


def test_counts_ranges_and_names_of_objects():
    assert [format_count(n, "episode") for n in (0, 1, 2)] == ["0 episodes", "1 episode", "2 episodes"]
    assert format_ranges([0, 1, 2, 5, 7, 8]) == "0-2, 5, 7-8"
    assert format_object_name("large_elephant", "grey toy elephant") == "grey toy elephant (large elephant)"
    assert (
        format_object_name("jam_jar", "jam jar")
        == format_object_name("jam_jar")
        == format_object_name("", "jam jar")
        == "jam jar"
    )
    assert format_object_name("") == ""


HOSTILE = (
    "\x1b]0;title\x07\x9b31m\x7f\u202eevil\u2069\u2028\r\udcff | `x` <script>alert(1)</script> [a](http://b) *c* &lt;"
)


def test_only_control_characters_are_escaped():
    shown = escape_controls(HOSTILE + "\n\té 😀 \u0645\u0646")
    assert shown.isprintable()
    assert shown.encode()
    assert "\\u001b]0;title\\u0007\\u009b31m\\u007f\\u202eevil\\u2069\\u2028\\u000d\\udcff | `x` <script>" in shown
    assert shown.endswith("\\u000a\\u0009é 😀 \u0645\u0646")
    assert escape_controls(shown) == shown
    assert escape_controls("a\n\tb\x1b\r", lines=True) == "a\n\tb\\u001b\\u000d"
    assert json.loads(escape_controls(json.dumps(HOSTILE, ensure_ascii=False))) == HOSTILE  # as `--json` prints it


MARKUP = "__bold__ _x_ a_b (_c_) https://a.example WWW.a.example ftp://b \\* $x$ C:\\_ end\\"


def test_a_text_in_markdown_has_no_markup():
    for text in (HOSTILE, MARKUP):
        shown = escape_markdown(text)
        assert shown.isprintable()
        assert not re.search(r"(?<!\\)(?:\\\\)*[<>|`*\[\]&$]|(?<!\\)://|www\.", shown, re.IGNORECASE)
        assert not re.search(r"(?<![\w\\])_|(?<!\\)_(?!\w)", shown)
        assert re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", shown) == escape_controls(text)
    assert escape_markdown("pick_table_scattered 0.5 \x1b") == "pick_table_scattered 0.5 \\u001b"


def test_errors_are_formatted_as_one_line():
    assert one_line(ValueError("a\n  b\x1b"), 3) == "a b"
    assert one_line(TimeoutError()) == "TimeoutError"
    assert one_line(KeyError("steps")) == "no key 'steps'"
    assert format_error(OSError("no\nroom")) == "OSError: no room"
    assert format_error(RobocasError("bad", where="file")) == "file: bad"


def test_log_lines_of_this_package_are_one_line_without_control_characters(tmp_path):
    script = (
        "import logging; from robocas_ms3.core.text import escape_log_lines; escape_log_lines()\n"
        "text = 'a\\x1b[31m\\n\\u202eb'\n"
        "logging.getLogger('robocas_ms3.x').warning('%s', text)\n"
        "logging.getLogger('other').warning('%s', text)\n"
        "try: raise ValueError(text)\n"
        "except ValueError: logging.getLogger('robocas_ms3.x').exception('failed')\n"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stderr
    assert said.startswith("a\\u001b[31m\\u000a\\u202eb\na\\u001b[31m\n\\u202eb\nfailed\nTraceback")
    assert all(character.isprintable() or character == "\n" for character in said)
