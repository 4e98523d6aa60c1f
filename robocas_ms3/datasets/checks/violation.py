"""Violations of the schema of a dataset, and the checks of JSON files against their models."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.strict_model import list_invalid_values
from robocas_ms3.core.text import one_line

NO_FILE = "no file"
_WORDS = {"int_type": "an integer", "string_type": "text", "dict_type": "an object", "model_type": "an object"}


@dataclass(frozen=True)
class Violation:
    """Violation of the schema: file and key of the wrong value, the expected value and the found value.

    ``key`` is empty if the whole file is wrong; ``file`` is empty if the whole dataset is wrong.
    """

    file: str
    key: str
    expected: str
    found: str
    kind: Literal["", "missing", "unexpected"] = ""

    @property
    def where(self) -> str:
        return ", ".join(part for part in (self.file, self.key) if part)

    def __str__(self) -> str:
        return f"{self.where or 'dataset'}: expected {self.expected}, found {self.found}"

    def as_json(self) -> dict[str, str]:
        return {"file": self.file, "key": self.key, "expected": self.expected, "found": self.found}


def read_json_object(
    root: Path, name: str, model: type[BaseModel] | None = None, *, expected_file: str = "this file"
) -> tuple[dict[str, Any], list[Violation]]:
    """Read a JSON file of a dataset; return its object (empty if it can't be read) and its violations.

    ``model``: the content must match this model. ``expected_file``: expected value in the violation of a missing file.
    """
    try:
        content = load_json(root / name)
    except FileNotFoundError:
        return {}, [Violation(name, "", expected_file, NO_FILE, "missing")]
    except (OSError, ValueError) as error:
        return {}, [Violation(name, "", "JSON", one_line(error))]
    if not isinstance(content, dict):
        return {}, [Violation(name, "", "an object", type(content).__name__)]
    return content, check_against_model(model, content, name) if model else []


def check_against_model(model: type[BaseModel], content: Mapping[str, Any], file: str) -> list[Violation]:
    """Check the content of a JSON file against a model; return one violation per invalid key.

    Only the first invalid element of a list is reported.
    """
    try:
        model.model_validate(content)
    except ValidationError as error:
        found: dict[str, Violation] = {}
        for mistake in list_invalid_values(error, words=_WORDS):
            expected, value = (
                mistake.expected or mistake.what.removeprefix(f"{mistake.key}: "),
                shorten_json(mistake.value),
            )
            if mistake.kind in ("too_short", "too_long"):
                limit = mistake.context.get("min_length", mistake.context.get("max_length"))
                expected, value = f"{limit} values", f"{mistake.context['actual_length']}"
            elif mistake.kind == "missing":
                value = "no such key"
            place = ".".join(word for word in mistake.key.split(".") if not word.isdecimal())
            found.setdefault(place, Violation(file, mistake.key, expected, value))
        return list(found.values())
    return []


def shorten_json(value: Any) -> str:
    """Return a JSON value as a text of at most 60 characters."""
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."
