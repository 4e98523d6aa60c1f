"""Data and numbers of others read strictly: the base of all declared forms, and pydantic's complaints in our words.

A message names the key, what was expected and what was found; of a mistyped key or word also the nearest known ones.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, model_validator

from robocas_ms3.core.documents import DocumentError, json_values
from robocas_ms3.core.errors import RobocasError

_Model = TypeVar("_Model", bound=BaseModel)
_Value = TypeVar("_Value")
_Error = TypeVar("_Error", bound=RobocasError)

# pydantic's words for what it wanted, where its message alone doesn't say it
_EXPECTED = {
    "extra_forbidden": "no such key",
    "missing": "this key",
    "string_type": "a string",
    "int_type": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "model_type": "a mapping",
    "dict_type": "a mapping",
}
_FOUND_LENGTH = 80  # of a wrong value in a message
_OUT_OF_RANGE = re.compile(rb"NaN|Infinity|\d[eE]\+?\d{3}|\d{19}")  # may be a number that `json_values` refuses


GREATEST_NUMBER = 1e12
"""No number of a declared form is larger: products of numbers like 1e308 are infinite."""


class StrictModel(BaseModel):
    """Refuse unknown keys and numbers beyond `GREATEST_NUMBER`; nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _numbers_are_bounded(self) -> StrictModel:
        for name, value in self:
            if (wrong := _too_large(value)) is not None:
                raise ValueError(f"{name}: expected numbers of at most {GREATEST_NUMBER:g}, found {wrong:g}")
        return self


def _too_large(value: Any) -> float | None:
    """Return a number beyond the greatest that is in a value, or None; models inside check their own."""
    if isinstance(value, int | float):
        return value if abs(value) > GREATEST_NUMBER else None
    inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return next((wrong for one in inside if (wrong := _too_large(one)) is not None), None)


@dataclass(frozen=True)
class Mistake:
    """Something wrong with a value, in one line each.

    Attributes:
        key: where, as the file has it; empty: at the top.
        kind: pydantic's name of it.
        what: is wrong.
        expected, found: in a file; empty where ``what`` says it all.
        fix: the nearest known words, where there are some.
        value: what was found.
        context: pydantic's limits and the like.
    """

    key: str
    kind: str
    what: str
    expected: str
    found: str
    fix: str
    value: Any
    context: Mapping[str, Any]


def parse(model: type[_Model], data: Any, error: type[RobocasError], *, where: object, about: str = "") -> _Model:
    """Values, as YAML has them, in a declared form.

    Args:
        model: the form.
        data: a mapping.
        error: to be raised.
        where: file or option of the values, for messages; or a function that returns it for the key of a mistake.
        about: what they aren't then, such as "no rules of a protocol".

    Raises:
        RobocasError: ``error``, for the first mistake; the count of further ones is in the message.
    """
    try:
        text = json.dumps(data, default=lambda value: {type(value).__name__: str(value)})  # as a date, which none takes
    except (TypeError, ValueError) as problem:  # such a key, or an alias of what holds it
        what = "a value here has no place in this file"
        where = where("") if callable(where) else where
        raise error(f"{about}: {what}" if about else what, where=where, found=problem) from problem
    # JSON mode: strict about types, yet lists serve as tuples and whole numbers as floats, as in YAML
    return parse_json(model, text, error, where=where, about=about)


def parse_json(
    model: type[_Model], text: str | bytes, error: type[RobocasError], *, where: object, about: str = ""
) -> _Model:
    """The same of JSON."""
    try:
        return validate_json(model, text)
    except ValidationError as problem:
        raise refusal(problem, model, error, where=where, about=about) from problem


def validate_json(form: type[_Model] | TypeAdapter[_Value], text: str | bytes) -> Any:
    """Read JSON strictly in a declared form; every number is finite and every integer has at most 64 bits.

    Raises:
        ValidationError: it says something else.
    """
    if isinstance(form, TypeAdapter):
        found: Any = form.validate_json(text, strict=True)
    else:
        found = form.model_validate_json(text, strict=True)
    if _OUT_OF_RANGE.search(text.encode() if isinstance(text, str) else text):  # hardly ever: then it is read once more
        try:
            json_values(text)
        except DocumentError as problem:
            said: Any = {"type": "json_invalid", "loc": (), "input": "", "ctx": {"error": str(problem)}}
            raise ValidationError.from_exception_data("JSON", [said]) from problem
    return found


def refusal(
    problem: ValidationError,
    form: type[BaseModel] | TypeAdapter[Any],
    error: type[_Error],
    *,
    where: object,
    about: str = "",
    fix: str = "",
) -> _Error:
    """What pydantic complains of as one of our errors: its first mistake, and how many more there are.

    Args:
        problem: pydantic's.
        form: that was asked for.
        error: to be made.
        where, about: see `parse`.
        fix: what to do, besides.
    """
    first, *others = mistakes(problem, form)
    # what may be of several types has a mistake for each, at its own place or further out
    more = sum(not f"{first.key}.".startswith(f"{other.key}." if other.key else "") for other in others)
    said = (first.fix, f"{more} more after this one." if more else "", fix)
    what = f"{about}: {first.what}" if about else first.what
    where = where(first.key) if callable(where) else where
    return error(what, where=where, expected=first.expected, found=first.found, fix=" ".join(filter(None, said)))


def mistakes(
    problem: ValidationError,
    form: type[BaseModel] | TypeAdapter[Any] | None = None,
    words: Mapping[str, str] | None = None,
) -> list[Mistake]:
    """What pydantic complains of, one mistake a key, unknown keys first.

    Args:
        problem: pydantic's.
        form: that was asked for; None: one without unions, whose alternatives pydantic takes for keys.
        words: for what was expected, by pydantic's kinds of mistakes, instead of ours.
    """
    schema = {} if form is None else _schema(form)
    found: dict[str, list[tuple[Any, dict[str, Any]]]] = {}
    for details in problem.errors(include_url=False):
        keys, node = _place(details["loc"], schema)
        found.setdefault(".".join(keys), []).append((details, node))
    said = [_mistake(key, same, schema, {**_EXPECTED, **(words or {})}) for key, same in found.items()]
    return sorted(said, key=lambda mistake: mistake.kind != "extra_forbidden")  # it may be why another is missing


def check_number(name: str, value: float, least: float, greatest: int | None = None) -> None:
    """Check the range of a number.

    Raises:
        RobocasError: it is outside.
    """
    if not least <= value < math.inf or (greatest is not None and value > greatest):
        expected = f"at least {least}" if greatest is None else f"{least} to {greatest}"
        raise RobocasError("this number is out of range", where=name, expected=expected, found=value)


def nearest(name: str, known: Iterable[str]) -> str:
    """A question that names the known words most like a wrong one, best first; empty where none is like it."""
    found = get_close_matches(name, list(known), n=3, cutoff=0.7)
    return f"Did you mean {' or '.join(found)}?" if found else ""


def _mistake(
    key: str, same: list[tuple[Any, dict[str, Any]]], schema: dict[str, Any], words: Mapping[str, str]
) -> Mistake:
    details, node = same[0]
    kind, value, context = details["type"], details["input"], details.get("ctx", {})
    if kind == "extra_forbidden":
        name, known = str(details["loc"][-1]), sorted(_place(details["loc"][:-1], schema)[1].get("properties", {}))
        expected = f"one of {known}" if known else "no such key"
        return Mistake(key, kind, f"unknown key {key!r}", expected, repr(name), nearest(name, known), value, context)
    if kind in {"union_tag_invalid", "union_tag_not_found"}:
        tag, kinds = node["discriminator"]["propertyName"], sorted(node["discriminator"]["mapping"])
        said = str(context.get("tag", ""))
        what = f"wrong value for '{f'{key}.{tag}' if key else tag}'"
        found = repr(said) if said else "nothing"
        return Mistake(key, kind, what, f"one of {kinds}", found, nearest(said, kinds), value, context)
    if kind == "value_error":
        what = _line(details["msg"].removeprefix("Value error, "))
        found = repr(value)[:_FOUND_LENGTH] if isinstance(value, (str, int, float)) and str(value) not in what else ""
        return Mistake(key, kind, f"{key}: {what}" if key else what, "", found, "", value, context)
    if kind == "json_invalid":
        return Mistake(key, kind, "this is not valid JSON", "", _line(context["error"]), "", value, context)
    expected = " or ".join(dict.fromkeys(_expected(details, words) for details, _ in same))
    found = "nothing" if kind == "missing" else repr(value)
    if len(found) > _FOUND_LENGTH:
        found = found[:_FOUND_LENGTH] + "..."
    return Mistake(key, kind, f"wrong value for {key or '(top level)'!r}", expected, found, "", value, context)


def _expected(details: Any, words: Mapping[str, str]) -> str:
    kind, place = details["type"], details["loc"]
    if kind == "missing" and place and isinstance(place[-1], int):
        return f"at least {place[-1] + 1} items in this list"
    if kind == "string_pattern_mismatch":
        return f"a string like {details['ctx']['pattern']}"
    said = re.sub(r"^(Value error, )?(Input|List|Tuple|Dictionary|String) should (be |have )?", "", details["msg"])
    return words.get(kind, _line(said.replace(" after validation", "")))


def _schema(form: type[BaseModel] | TypeAdapter[Any]) -> dict[str, Any]:
    return form.json_schema() if isinstance(form, TypeAdapter) else form.model_json_schema()


def _place(location: tuple[int | str, ...], schema: dict[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """Where a mistake is, for messages.

    Returns:
        The keys that lead there, as the file has them (pydantic adds the kind where a block comes in several, the
        type where a value may be of several, and "[key]" where a key itself is wrong), and the JSON schema of what
        belongs there; empty where it is not known.
    """
    node = _resolved(schema, schema)
    keys: list[str] = []
    for part in location:
        kinds = node.get("discriminator", {}).get("mapping", {})
        choices = node.get("anyOf", ())
        if part == "[key]":
            continue
        if part in kinds:
            node = {"$ref": kinds[part]}
        elif choices:
            node = next((choice for choice in choices if choice.get("type") == "array"), {})
        else:
            keys.append(" ".join(str(part).split()))
            inner = node.get("properties", {}).get(part) or node.get("additionalProperties") or node.get("items")
            node = inner if isinstance(inner, dict) else {}
        node = _resolved(node, schema)
    return keys, node


def _resolved(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    real = [choice for choice in node.get("anyOf", ()) if choice.get("type") != "null"]
    node = real[0] if len(real) == 1 else node  # X | None
    return schema["$defs"][node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node


def _line(text: object) -> str:
    return " ".join(str(text).split())
