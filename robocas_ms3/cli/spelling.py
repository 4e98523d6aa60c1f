"""Options and choices of a command line that its command does not have, told in one line, with the nearest it has."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tyro

_ALWAYS = ("--help", "--debug")


@dataclass(frozen=True)
class _Option:
    """One of a command's.

    Attributes:
        names: of the flag, as they may be written; of a positional one none.
        what: it is.
        choices: of its value; none where there are others than words.
    """

    names: tuple[str, ...]
    what: str
    choices: tuple[str, ...]


def misspelt(of_command: type, prog: str, words: Sequence[str]) -> str:
    """What no option or choice of a command is like this, with the nearest that is; empty: there is nothing.

    Args:
        of_command: its dataclass.
        prog: what it is called.
        words: after that.
    """
    from robocas_ms3.core.strict import nearest

    options = list(_options(of_command))
    known = {name: option for option in options for name in option.names}
    if options and not options[0].names and words and not words[0].startswith("-"):
        known[""], words = options[0], ["", *words]
    for number, word in enumerate(words):
        flag, equals, value = word.partition("=")
        flag = flag.replace("_", "-")
        if flag.startswith("--") and flag not in (*known, *_ALWAYS) and not flag.startswith("--tyro-"):
            fix = nearest(flag, [name for name in known if name.startswith("--")]) or f"See {prog} --help."
            return f"{flag}: no such option of {prog}. {fix}"
        option = known.get(flag)
        if option is None or not option.choices:
            continue
        value = value if equals else words[number + 1] if number + 1 < len(words) else ""
        if value and not value.startswith("-") and value not in option.choices:
            fix = nearest(value, option.choices)
            return f"{value}: no such {option.what} (expected one of {', '.join(option.choices)}). {fix}".rstrip()
    return ""


def _options(of_command: type) -> Iterator[_Option]:
    """Of a dataclass, in its order."""
    plain, full = get_type_hints(of_command), get_type_hints(of_command, include_extras=True)
    for field in fields(of_command):
        about = getattr(full[field.name], "__metadata__", ())
        name = field.name.replace("_", "-")
        names = (f"--{name}", *(alias for one in about for alias in getattr(one, "aliases", None) or ()))
        if plain[field.name] is bool:
            names = (*names, f"--no-{name}")
        if tyro.conf.Positional in about:
            names = ()
        yield _Option(names, name.replace("-", " "), _choices(plain[field.name]))


def _choices(of: Any) -> tuple[str, ...]:
    """Words that a type has, also one that may be None; not of several values, whose number is not known."""
    kinds = [of] if get_origin(of) is Literal else [kind for kind in get_args(of) if get_origin(kind) is Literal]
    if get_origin(of) is tuple or len(kinds) != 1:
        return ()
    return tuple(map(str, get_args(kinds[0])))
