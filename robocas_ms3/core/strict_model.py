"""Validate untrusted data strictly with pydantic, and convert its errors to one-line messages.

A message has the key, the expected and the found value, and suggestions for a misspelled key or word.
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
from robocas_ms3.core.text import did_you_mean, format_count, one_line

_Model = TypeVar("_Model", bound=BaseModel)
_Error = TypeVar("_Error", bound=RobocasError)
MAX_NUMBER = 1e12
"""Largest magnitude of numbers in a `StrictModel`: products of numbers such as 1e308 are infinite."""
MAX_NAME_BYTES = 200
"""Bytes of a file name; file systems allow 255, and temporary names are longer."""
_NAME = f"1 to {MAX_NAME_BYTES} printable characters without / and \\, no leading dot"
# expected values by error type, if pydantic's message does not name them
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
_FOUND_LENGTH = 80  # characters of an invalid value or a key in a message
_OUT_OF_RANGE = re.compile(rb"NaN|Infinity|\d[eE]\+?\d{3}|\d{19}")  # possibly a number that `decode_json` refuses


class StrictModel(BaseModel):
    """Base class of immutable pydantic models; unknown keys and numbers over `MAX_NUMBER` are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _check_numbers(self) -> StrictModel:
        for name, value in self:
            if (wrong := _find_large_number(value)) is not None:
                raise ValueError(f"{name}: expected numbers of at most {MAX_NUMBER:g}, found {wrong:g}")
        return self


def _find_large_number(value: Any) -> float | None:
    """Find a number in a value whose magnitude exceeds `MAX_NUMBER`.

    Nested models are not searched, because they check their numbers themselves.

    Returns:
        The number, or None.
    """
    if isinstance(value, int | float):
        return value if abs(value) > MAX_NUMBER else None
    inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return next((wrong for item in inside if (wrong := _find_large_number(item)) is not None), None)


@dataclass(frozen=True)
class InvalidValue:
    """One invalid value of a file: key, problem, expected and found value, as one-line texts of a pydantic error."""

    key: str  # dotted path in the file; empty: top level
    kind: str  # error type of pydantic
    what: str
    expected: str  # empty if `what` contains it, as is `found`
    found: str
    fix: str  # suggestions, or empty
    value: Any
    context: Mapping[str, Any]  # `ctx` of pydantic, such as limits


def parse(model: type[_Model], data: Any, error: type[RobocasError], *, where: object, about: str = "") -> _Model:
    """Validate values that were read from YAML, and return them as a model.

    Args:
        model: class of the model.
        data: a mapping.
        error: type of the error to raise.
        where: file or option of the values, for messages; or a function that returns the file or option of a key.
        about: start of the message, such as "not a valid plan".

    Raises:
        RobocasError: an ``error`` for the first invalid value, with the number of further invalid values.
    """
    try:
        text = json.dumps(
            data, default=lambda value: {type(value).__name__: str(value)}
        )  # such as a date, which no model accepts
    except (TypeError, ValueError) as problem:  # a key of another type, or a YAML alias of its own parent
        what = "a key that is not text, or a YAML alias that contains itself"
        where = where("") if callable(where) else where
        raise error(f"{about}: {what}" if about else what, where=where, found=problem) from problem
    # strict JSON mode accepts lists as tuples and integers as floats, as needed for YAML
    return parse_json(model, text, error, where=where, about=about)


def parse_json(
    model: type[_Model], text: str | bytes, error: type[RobocasError], *, where: object, about: str = ""
) -> _Model:
    """Validate a JSON text and return it as a model; the arguments and errors are those of `parse`."""
    try:
        return validate_json(model, text)
    except ValidationError as problem:
        raise error_from_validation(problem, model, error, where=where, about=about) from problem


def validate_json(form: type[BaseModel] | TypeAdapter[Any], text: str | bytes) -> Any:
    """Validate a JSON text strictly and return its values in the type of ``form``.

    Raises:
        ValidationError: a value is invalid, or NaN, infinite, or an integer of more than 64 bits.
    """
    validate = form.validate_json if isinstance(form, TypeAdapter) else form.model_validate_json
    found = validate(text, strict=True)
    if _OUT_OF_RANGE.search(text.encode() if isinstance(text, str) else text):  # rarely true
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
    """Convert a pydantic error to an ``error`` with the first invalid value and the number of other invalid values.

    Args:
        problem: error of pydantic.
        form: model or type that was validated.
        error: type of the error to make.
        where: as in `parse`.
        about: start of the message.
        fix: sentence that tells the user how to solve the problem.
    """
    first, *others = list_invalid_values(problem, form)
    # a union reports one error per type, at its own key or at an outer key
    more = sum(not f"{first.key}.".startswith(f"{other.key}." if other.key else "") for other in others)
    fixes = (first.fix, f"{format_count(more, 'more error')}." if more else "", fix)
    what = f"{about}: {first.what}" if about else first.what
    where = where(first.key) if callable(where) else where
    return error(what, where=where, expected=first.expected, found=first.found, fix=" ".join(filter(None, fixes)))


def list_invalid_values(
    problem: ValidationError,
    form: type[BaseModel] | TypeAdapter[Any] | None = None,
    words: Mapping[str, str] | None = None,
) -> list[InvalidValue]:
    """List the invalid values of a pydantic error, one per key, unknown keys first.

    Args:
        problem: error of pydantic.
        form: model or type that was validated. It is needed for types with unions, because pydantic reports the types
            of a union as keys.
        words: texts for expected values by error type of pydantic, in addition to the standard ones.
    """
    schema: dict[str, Any] = {}
    if form is not None:
        schema = form.json_schema() if isinstance(form, TypeAdapter) else form.model_json_schema()
    found: dict[str, list[Any]] = {}
    for details in problem.errors(include_url=False):
        found.setdefault(".".join(_locate_value(details["loc"], schema)[0]), []).append(details)
    made = [_make_invalid_value(key, same, schema, {**_EXPECTED, **(words or {})}) for key, same in found.items()]
    return sorted(
        made, key=lambda value: value.kind != "extra_forbidden"
    )  # a misspelled key is also reported as missing


def check_name(name: str, error: type[RobocasError], *, where: object, fix: str = "") -> str:
    """Return a name unchanged; raise ``error`` if the name is not valid for a file or folder."""
    try:
        return _check_name(name)
    except ValueError as problem:
        what, found = "invalid file name", f"{name!r:.80}"
        raise error(what, where=where, expected=_NAME, found=found, fix=fix) from problem


def _check_name(name: str) -> str:
    fits = 0 < len(name.encode()) <= MAX_NAME_BYTES
    if not (fits and name.isprintable()) or name.startswith(".") or {*name} & {"/", "\\"}:
        raise ValueError(f"invalid file name: expected {_NAME}")
    return name


FileName = Annotated[str, AfterValidator(_check_name)]
"""Type of a model's field that is used as a file name."""


def _make_invalid_value(key: str, same: list[Any], schema: dict[str, Any], words: Mapping[str, str]) -> InvalidValue:
    details = same[0]
    kind, value, context = details["type"], details["input"], details.get("ctx", {})
    what, expected, found, fix = f"invalid value for {key or '(top level)'!r}", "", "", ""
    if kind == "extra_forbidden":
        *outer, name = details["loc"]
        name, known = (
            one_line(name, _FOUND_LENGTH),
            sorted(_locate_value(tuple(outer), schema)[1].get("properties", {})),
        )
        what, expected = f"unknown key {key!r}", f"one of {', '.join(known)}" if known else "no such key"
        found, fix = repr(name), did_you_mean(name, known)
    elif kind in {"union_tag_invalid", "union_tag_not_found"}:
        discriminator = _locate_value(details["loc"], schema)[1]["discriminator"]
        tag, kinds = discriminator["propertyName"], sorted(discriminator["mapping"])
        name = one_line(context.get("tag", ""), _FOUND_LENGTH)
        what, expected = f"invalid value for '{f'{key}.{tag}' if key else tag}'", f"one of {', '.join(kinds)}"
        found, fix = repr(name) if name else "nothing", did_you_mean(name, kinds)
    elif kind == "value_error":
        message = one_line(details["msg"].removeprefix("Value error, "))
        what = f"{key}: {message}" if key else message
        found = repr(value)[:_FOUND_LENGTH] if isinstance(value, str | int | float) and str(value) not in what else ""
    elif kind == "json_invalid":
        what, found = "invalid JSON", one_line(context["error"])
    else:
        expected = " or ".join(dict.fromkeys(_describe_expected(details, words) for details in same))
        found = "nothing" if kind == "missing" else repr(value)
        found = found if len(found) <= _FOUND_LENGTH else f"{found[:_FOUND_LENGTH]}..."
    return InvalidValue(key, kind, what, expected, found, fix, value, context)


def _describe_expected(details: Any, words: Mapping[str, str]) -> str:
    kind, place = details["type"], details["loc"]
    if kind == "missing" and place and isinstance(place[-1], int):
        return f"at least {place[-1] + 1} items in this list"
    if kind == "string_pattern_mismatch":
        return f"a string like {details['ctx']['pattern']}"
    message = re.sub(r"^(Value error, )?(Input|List|Tuple|Dictionary|String) should (be |have )?", "", details["msg"])
    return words.get(kind, one_line(message.replace(" after validation", "")))


def _locate_value(location: tuple[int | str, ...], schema: dict[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """Return the path of keys to an invalid value in its file, and the JSON schema of the value ({} if unknown).

    ``location`` of pydantic also has tags of tagged unions, types of values, and "[key]" for an invalid key.
    """
    node = _resolve_reference(schema, schema)
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
        node = _resolve_reference(node, schema)
    return keys, node


def _resolve_reference(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    real = [choice for choice in node.get("anyOf", ()) if choice.get("type") != "null"]
    node = real[0] if len(real) == 1 else node  # X | None
    return schema["$defs"][node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node
