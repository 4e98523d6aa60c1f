"""Texts of messages: counts and names, and data in a form that a terminal or a report shows as it is."""

from __future__ import annotations

import logging
import re
from typing import Any

# C0, DEL and C1 control characters, line and paragraph separators, marks and overrides of the text direction, lone
# surrogates (bytes of a file name that are not UTF-8)
_UNPRINTABLE = r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
_CONTROL = re.compile(_UNPRINTABLE)
_CONTROL_IN_LINES = re.compile(rf"(?![\n\t]){_UNPRINTABLE}")
_MARKDOWN = re.compile(r"[\\`*\[\]<>|&~]")


def printable(text: str, *, lines: bool = False) -> str:
    r"""Return a text with control characters as escapes (``\u001b``, valid in JSON too), for terminals and reports.

    Args:
        text: from anywhere: a name in a file, an error message, a reply of a server.
        lines: whether line breaks and tabs stay, as in a text of several lines.
    """
    pattern = _CONTROL_IN_LINES if lines else _CONTROL
    return pattern.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def in_markdown(text: str) -> str:
    """Return a text as one line of Markdown that shows it as it is: no HTML, links, emphasis or table cells."""
    return _MARKDOWN.sub(r"\\\g<0>", printable(text))


class _LogLines(logging.Formatter):
    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (logging's name)
        """Return the message: one line where it is this package's, others may have several."""
        return printable(super().formatMessage(record), lines=not record.name.startswith("robocas_ms3"))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        """Return a traceback."""
        return printable(super().formatException(ei), lines=True)


def escape_log_lines() -> None:
    """Show control characters in log lines as escapes, in this process, where nobody set up a log handler."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_LogLines())


def count_of(count: int, noun: str) -> str:
    """``1 episode``, ``2 episodes``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def called(asset_id: str, name: str = "") -> str:
    """What people read of an object: what instructions call it, and its id where that says something else.

    Args:
        asset_id: of its pack; empty: not known.
        name: in instructions; empty: not known.
    """
    plain = asset_id.replace("_", " ")
    return f"{name} ({plain})" if name and plain and name != plain else name or plain
