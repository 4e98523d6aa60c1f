"""Texts of datasets on the page."""

import json

from robocas_ms3.viewer.routes import script


def test_control_characters_reach_the_page_as_escapes():
    texts = ["\x1b[31m\x9b\x7f", "\u202eevil\u2069\u2028", "\\u202e", "\\\u202e\u202e", "é 😀 \u0645", "two\nlines"]
    data = script("index", {"name": texts, "number": float("nan")})
    assert data.isascii()
    shown = json.loads(data[len(b'robocas.put("index",') : -len(b");\n")])
    assert shown["name"] == [
        *("\\u001b[31m\\u009b\\u007f", "\\u202eevil\\u2069\\u2028"),
        *("\\u202e", "\\\\u202e\\u202e", "é 😀 \u0645", "two\nlines"),
    ]
