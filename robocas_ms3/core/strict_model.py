"""Data of others read strictly: the base of all declared forms, and pydantic's errors in our words.

A message names the key, what was expected and what was found; of a mistyped key or word also the nearest known ones.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, TypeAdapter, ValidationError, model_validator

from robocas_ms3.core.documents import DocumentError, decode_json
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.text import did_you_mean, one_line

_Model = TypeVar("_Model", bound=BaseModel)
_Error = TypeVar("_Error", bound=RobocasError)
MAX_NUMBER = 1e12
"""No number of a declared form is larger: products of numbers like 1e308 are infinite."""
MAX_NAME_BYTES = 200
"""Bytes; file systems allow 255, of which temporary files add some."""
_NAME = f"1 to {MAX_NAME_BYTES} printable characters without / and \\, no leading dot"
# where pydantic's message alone does not say what was expected
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
_FOUND_LENGTH = 80  # of a wrong value, or of a key, in a message
_OUT_OF_RANGE = re.compile(rb"NaN|Infinity|\d[eE]\+?\d{3}|\d{19}")  # may be a number that `decode_json` refuses


class StrictModel(BaseModel):
    """Refuse unknown keys and numbers beyond `MAX_NUMBER`; nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _numbers_are_bounded(self) -> StrictModel:
        for name, value in self:
            if (wrong := _too_large(value)) is not None:
                raise ValueError(f"{name}: expected numbers of at most {MAX_NUMBER:g}, found {wrong:g}")
        return self


def _too_large(value: Any) -> float | None:
    """Return a number beyond the greatest that is in a value, or None; models inside check their own."""
    if isinstance(value, int | float):
        return value if abs(value) > MAX_NUMBER else None
    inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return next((wrong for each in inside if (wrong := _too_large(each)) is not None), None)


@dataclass(frozen=True)
class InvalidValue:
    """An invalid value, in one line each."""

    key: str  # as the file has it; empty: at the top
    kind: str  # pydantic's type of the error
    what: str
    expected: str  # empty, as `found`, where `what` says it all
    found: str
    fix: str  # the nearest known words, where there are some
    value: Any
    context: Mapping[str, Any]  # pydantic's limits and the like


def parse(model: type[_Model], data: Any, error: type[RobocasError], *, where: object, about: str = "") -> _Model:
    """Return values, as YAML has them, in a declared form.

    Args:
        model: the form.
        data: a mapping.
        error: to be raised.
        where: file or option of the values, for messages; or a function that returns it for the key of a mistake.
        about: what the values aren't then, such as "not a valid plan".

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
    """Return the values of a JSON text in a declared form; see `parse`."""
    try:
        return validate_json(model, text)
    except ValidationError as problem:
        raise error_from_validation(problem, model, error, where=where, about=about) from problem


def validate_json(form: type[BaseModel] | TypeAdapter[Any], text: str | bytes) -> Any:
    """Read JSON strictly in a declared form, or raise ValidationError; numbers are finite, integers have 64 bits."""
    validate = form.validate_json if isinstance(form, TypeAdapter) else form.model_validate_json
    found = validate(text, strict=True)
    if _OUT_OF_RANGE.search(text.encode() if isinstance(text, str) else text):  # hardly ever: then it is read once more
        try:
            decode_json(text)
        except DocumentError as problem:
            details: Any = {"type": "json_invalid", "loc": (), "input": "", "ctx": {"error": str(problem)}}
            raise ValidationError.from_exception_data("JSON", [details]) from problem
    return found


def error_from_validation(
    problem: ValidationError,
    form: type[BaseModel] | TypeAdapter[Any],
    error: type[_Error],
    *,
    where: object,
    about: str = "",
    fix: str = "",
) -> _Error:
    """Return pydantic's error as one of ours: its first mistake, and how many more there are; see `parse`."""
    first, *others = list_invalid_values(problem, form)
    # a union has a mistake for each of its types, at its own place or further out
    more = sum(not f"{first.key}.".startswith(f"{other.key}." if other.key else "") for other in others)
    fixes = (first.fix, f"{more} more after this one." if more else "", fix)
    what = f"{about}: {first.what}" if about else first.what
    where = where(first.key) if callable(where) else where
    return error(what, where=where, expected=first.expected, found=first.found, fix=" ".join(filter(None, fixes)))


def list_invalid_values(
    problem: ValidationError,
    form: type[BaseModel] | TypeAdapter[Any] | None = None,
    words: Mapping[str, str] | None = None,
) -> list[InvalidValue]:
    """Return pydantic's errors, one mistake per key, unknown keys first.

    Args:
        problem: pydantic's.
        form: that was asked for; None: one without unions, whose alternatives pydantic takes for keys.
        words: for what was expected, by pydantic's types of errors, in addition to ours.
    """
    schema: dict[str, Any] = {}
    if form is not None:
        schema = form.json_schema() if isinstance(form, TypeAdapter) else form.model_json_schema()
    found: dict[str, list[Any]] = {}
    for details in problem.errors(include_url=False):
        found.setdefault(".".join(_place(details["loc"], schema)[0]), []).append(details)
    made = [_invalid_value(key, same, schema, {**_EXPECTED, **(words or {})}) for key, same in found.items()]
    return sorted(made, key=lambda mistake: mistake.kind != "extra_forbidden")  # it may be why another is missing


def check_name(name: str, error: type[RobocasError], *, where: object, fix: str = "") -> str:
    """Return a name that can be that of one file or folder; raise ``error`` if it can't be used in a path."""
    try:
        return _check_name(name)
    except ValueError as problem:
        what, found = "this name can't be used for a file", f"{name!r:.80}"
        raise error(what, where=where, expected=_NAME, found=found, fix=fix) from problem


def _check_name(name: str) -> str:
    fits = 0 < len(name.encode()) <= MAX_NAME_BYTES
    if not (fits and name.isprintable()) or name.startswith(".") or {*name} & {"/", "\\"}:
        raise ValueError(f"not a name for a file: expected {_NAME}")
    return name


FileName = Annotated[str, AfterValidator(_check_name)]
"""A field of a declared form that becomes a part of a path."""


def _invalid_value(key: str, same: list[Any], schema: dict[str, Any], words: Mapping[str, str]) -> InvalidValue:
    details = same[0]
    kind, value, context = details["type"], details["input"], details.get("ctx", {})
    what, expected, found, fix = f"wrong value for {key or '(top level)'!r}", "", "", ""
    if kind == "extra_forbidden":
        *outer, name = details["loc"]
        name, known = one_line(name, _FOUND_LENGTH), sorted(_place(tuple(outer), schema)[1].get("properties", {}))
        what, expected = f"unknown key {key!r}", f"one of {known}" if known else "no such key"
        found, fix = repr(name), did_you_mean(name, known)
    elif kind in {"union_tag_invalid", "union_tag_not_found"}:
        discriminator = _place(details["loc"], schema)[1]["discriminator"]
        tag, kinds = discriminator["propertyName"], sorted(discriminator["mapping"])
        name = one_line(context.get("tag", ""), _FOUND_LENGTH)
        what, expected = f"wrong value for '{f'{key}.{tag}' if key else tag}'", f"one of {kinds}"
        found, fix = repr(name) if name else "nothing", did_you_mean(name, kinds)
    elif kind == "value_error":
        message = one_line(details["msg"].removeprefix("Value error, "))
        what = f"{key}: {message}" if key else message
        found = repr(value)[:_FOUND_LENGTH] if isinstance(value, str | int | float) and str(value) not in what else ""
    elif kind == "json_invalid":
        what, found = "this is not valid JSON", one_line(context["error"])
    else:
        expected = " or ".join(dict.fromkeys(_expected(details, words) for details in same))
        found = "nothing" if kind == "missing" else repr(value)
        found = found if len(found) <= _FOUND_LENGTH else f"{found[:_FOUND_LENGTH]}..."
    return InvalidValue(key, kind, what, expected, found, fix, value, context)


def _expected(details: Any, words: Mapping[str, str]) -> str:
    kind, place = details["type"], details["loc"]
    if kind == "missing" and place and isinstance(place[-1], int):
        return f"at least {place[-1] + 1} items in this list"
    if kind == "string_pattern_mismatch":
        return f"a string like {details['ctx']['pattern']}"
    message = re.sub(r"^(Value error, )?(Input|List|Tuple|Dictionary|String) should (be |have )?", "", details["msg"])
    return words.get(kind, one_line(message.replace(" after validation", "")))


def _place(location: tuple[int | str, ...], schema: dict[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """Return the keys that lead to a mistake, as the file has them, and the JSON schema of what belongs there, or {}.

    pydantic adds the kind of a block that comes in several, the type of a value, and "[key]" where a key is wrong.
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
            keys.append(one_line(part, _FOUND_LENGTH))
            inner = node.get("properties", {}).get(part) or node.get("additionalProperties") or node.get("items")
            node = inner if isinstance(inner, dict) else {}
        node = _resolved(node, schema)
    return keys, node


def _resolved(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    real = [choice for choice in node.get("anyOf", ()) if choice.get("type") != "null"]
    node = real[0] if len(real) == 1 else node  # X | None
    return schema["$defs"][node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node
