"""Texts of messages: counts and names, and data in a form that a terminal or a report shows as it is."""

from __future__ import annotations

import logging
import re
import sys
import threading
import traceback
from collections.abc import Iterable
from difflib import get_close_matches
from types import TracebackType
from typing import Any

from robocas_ms3.core.errors import RobocasError

# C0, DEL and C1 control characters, line and paragraph separators, marks and overrides of the text direction, lone
# surrogates (bytes of a file name that are not UTF-8)
_UNPRINTABLE = r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
_CONTROL = re.compile(_UNPRINTABLE)
_CONTROL_IN_LINES = re.compile(rf"(?![\n\t]){_UNPRINTABLE}")
_RANGES = 6  # of numbers in a message
_MARKDOWN = re.compile(
    r"[`*\[\]<>|&~$]"
    r"|\\(?=[!-/:-@\[-`{-~]|$)"  # a backslash is markup only before punctuation
    r"|(?<![^\W_])_|_(?![^\W_])"  # and `_` only at an end of a word
    r"|:(?=//)|(?<=www)\.",  # links without brackets
    re.IGNORECASE,
)


def format_ranges(numbers: Iterable[int]) -> str:
    """Format numbers as ``0-3, 7``, with at most six ranges."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    texts = [str(a) if a == b else f"{a}-{b}" for a, b in runs]
    more = f" and {sum(b - a + 1 for a, b in runs[_RANGES:])} more" if len(runs) > _RANGES else ""
    return ", ".join(texts[:_RANGES]) + more


def escape_controls(text: str, *, lines: bool = False) -> str:
    r"""Return a text with control characters as escapes (``\u001b``, valid in JSON too), for terminals and reports.

    Args:
        text: from anywhere: a name in a file, an error message, a reply of a server.
        lines: whether line breaks and tabs stay, as in a text of several lines.
    """
    pattern = _CONTROL_IN_LINES if lines else _CONTROL
    return pattern.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def one_line(text: object, most: int | None = None) -> str:
    """Return a text or an error's message as one printable line; an error without a message gives its type's name.

    Args:
        text: from anywhere.
        most: characters of the text that are shown; None: all.
    """
    if isinstance(text, KeyError) and text.args:
        text = f"no key {text}"
    line = " ".join(str(text).split()) or (type(text).__name__ if isinstance(text, BaseException) else "")
    return escape_controls(line[:most])


def format_error(error: BaseException, most: int | None = None) -> str:
    """Return an error as `one_line` does, after the name of its type where it is not one of ours."""
    return one_line(error if isinstance(error, RobocasError) else f"{type(error).__name__}: {error}", most)


def escape_markdown(text: str) -> str:
    """Return a text as one line of Markdown that shows it as it is: no HTML, web links, emphasis or cells."""
    return _MARKDOWN.sub(r"\\\g<0>", escape_controls(text))


class _EscapingFormatter(logging.Formatter):
    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (logging's name)
        """Return the message: one line where it is this package's, others may have several."""
        return escape_controls(super().formatMessage(record), lines=not record.name.startswith("robocas_ms3"))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        return escape_controls(super().formatException(ei), lines=True)


def escape_log_lines() -> None:
    """Show control characters in log lines as escapes, in this process, where nobody set up a log handler."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_EscapingFormatter())


def print_traceback(kind: type[BaseException], error: BaseException | None, at: TracebackType | None) -> None:
    """Print a traceback on stderr, control characters as escapes; a `sys.excepthook`."""
    sys.stderr.write(escape_controls("".join(traceback.format_exception(kind, error, at)), lines=True))


def escape_tracebacks() -> None:
    """Show control characters in errors that nothing catches as escapes, in all threads of this process."""
    sys.excepthook = print_traceback
    threading.excepthook = sys.unraisablehook = _print_error


def _print_error(args: threading.ExceptHookArgs | sys.UnraisableHookArgs) -> None:
    if not issubclass(args.exc_type, SystemExit):  # which ends a thread, and is no error
        print_traceback(args.exc_type, args.exc_value, args.exc_traceback)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a question that names the known words most like a wrong one, best first; empty if none is like it."""
    found = get_close_matches(name, list(known), n=3, cutoff=0.7)
    return f"Did you mean {' or '.join(found)}?" if found else ""


def format_count(count: int, noun: str) -> str:
    """Return ``1 episode``, ``2 episodes``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def format_object_name(asset_id: str, name: str = "") -> str:
    """Return the name of an object in instructions, and its id where that differs; either may be unknown, empty."""
    plain = asset_id.replace("_", " ")
    return f"{name} ({plain})" if name and plain and name != plain else name or plain
