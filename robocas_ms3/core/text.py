"""Format text for messages, terminals and reports: counts, names, escapes, suggestions."""

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

# C0, DEL and C1 control characters, line and paragraph separators, marks and overrides of the text direction, and lone
# surrogates (bytes of a file name that are not UTF-8)
_UNPRINTABLE = r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
_CONTROL = re.compile(_UNPRINTABLE)
_CONTROL_IN_LINES = re.compile(rf"(?![\n\t]){_UNPRINTABLE}")
_MAX_RANGES = 6  # in a message
_MARKDOWN = re.compile(
    r"[`*\[\]<>|&~$]"
    r"|\\(?=[!-/:-@\[-`{-~]|$)"  # a backslash is markup only before punctuation
    r"|(?<![^\W_])_|_(?![^\W_])"  # an underscore is markup only at an end of a word
    r"|:(?=//)|(?<=www)\.",  # links without brackets
    re.IGNORECASE,
)


def format_ranges(numbers: Iterable[int]) -> str:
    """Format integers as ranges, such as ``0-3, 7``; at most six ranges, then the number of remaining integers."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    texts = [str(a) if a == b else f"{a}-{b}" for a, b in runs]
    more = f" and {sum(b - a + 1 for a, b in runs[_MAX_RANGES:])} more" if len(runs) > _MAX_RANGES else ""
    return ", ".join(texts[:_MAX_RANGES]) + more


def escape_controls(text: str, *, lines: bool = False) -> str:
    r"""Escape control characters as ``\u001b``, which is also valid JSON, for terminals and reports.

    Args:
        text: untrusted text, such as a name in a file, an error message or a reply of a server.
        lines: whether to keep line breaks and tabs.
    """
    pattern = _CONTROL_IN_LINES if lines else _CONTROL
    return pattern.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def one_line(text: object, max_length: int | None = None) -> str:
    """Convert a text, or the message of an error, to one printable line.

    Args:
        text: untrusted text, or an error; an error without a message is shown by the name of its type.
        max_length: number of characters to keep; None: all.
    """
    if isinstance(text, KeyError) and text.args:
        text = f"no key {text}"
    line = " ".join(str(text).split()) or (type(text).__name__ if isinstance(text, BaseException) else "")
    return escape_controls(line[:max_length])


def format_error(error: BaseException, max_length: int | None = None) -> str:
    """Format an error as one line; the line starts with the type of the error, unless it is a RobocasError."""
    return one_line(error if isinstance(error, RobocasError) else f"{type(error).__name__}: {error}", max_length)


def escape_markdown(text: str) -> str:
    """Escape a text for one line of Markdown, so that it creates no HTML, links, emphasis or table cells."""
    return _MARKDOWN.sub(r"\\\g<0>", escape_controls(text))


class _EscapingFormatter(logging.Formatter):
    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (logging's name)
        """Format a log record with control characters escaped; only records of other packages keep line breaks."""
        return escape_controls(super().formatMessage(record), lines=not record.name.startswith("robocas_ms3"))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        return escape_controls(super().formatException(ei), lines=True)


def escape_log_lines() -> None:
    """Escape control characters in log lines of this process if no log handler is configured."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_EscapingFormatter())


def print_traceback(kind: type[BaseException], error: BaseException | None, at: TracebackType | None) -> None:
    """Print a traceback to stderr with control characters escaped; a `sys.excepthook`."""
    sys.stderr.write(escape_controls("".join(traceback.format_exception(kind, error, at)), lines=True))


def escape_tracebacks() -> None:
    """Escape control characters in tracebacks of uncaught errors, in all threads of this process."""
    sys.excepthook = print_traceback
    threading.excepthook = sys.unraisablehook = _print_error


def _print_error(args: threading.ExceptHookArgs | sys.UnraisableHookArgs) -> None:
    if not issubclass(args.exc_type, SystemExit):  # SystemExit ends a thread, and is not an error
        print_traceback(args.exc_type, args.exc_value, args.exc_traceback)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "Did you mean ...?" with the known names most similar to ``name``; empty if none is similar."""
    found = get_close_matches(name, list(known), n=3, cutoff=0.7)
    return f"Did you mean {' or '.join(found)}?" if found else ""


def format_count(count: int, noun: str) -> str:
    """Return a count with its noun: ``1 episode``, ``2 episodes``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def format_object_name(asset_id: str, name: str = "") -> str:
    """Format an object for tables and messages: its name in instructions, with its asset id if the two differ.

    Args:
        asset_id: id of the asset, such as ``tomato_soup_can``; empty: unknown.
        name: name in instructions; empty: unknown.
    """
    plain = asset_id.replace("_", " ")
    return f"{name} ({plain})" if name and plain and name != plain else name or plain
