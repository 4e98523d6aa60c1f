"""Differences between a dataset and its declared form; those of JSON files are found by their models."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.strict import Mistake, mistakes
from robocas_ms3.core.words import one_line

NO_FILE = "no file"
_WORDS = {"int_type": "an integer", "string_type": "text", "dict_type": "an object", "model_type": "an object"}


@dataclass(frozen=True)
class Violation:
    """A difference from the schema.

    Attributes:
        file: path in the dataset; empty: the dataset as a whole.
        key: in that file; empty: the file itself.
        expected: by the schema.
        found: instead.
    """

    file: str
    key: str
    expected: str
    found: str

    def __str__(self) -> str:
        where = ", ".join(part for part in (self.file, self.key) if part) or "dataset"
        return f"{where}: expected {self.expected}, found {self.found}"


def read_object(
    root: Path,
    name: str,
    model: type[BaseModel] | None = None,
    *,
    expected: str = "JSON",
    absent: str = "this file",
    missing: str = NO_FILE,
) -> tuple[dict[str, Any], list[Violation]]:
    """Return the object in a JSON file of a dataset, empty if it can't be read, and what is wrong with it.

    Args:
        root: folder of the dataset.
        name: path of the file in it.
        model: declared form of the content; None: any object.
        expected: expectation that a damaged file breaks.
        absent, missing: expected and found if there is no such file.
    """
    try:
        content = load_json(root / name)
    except FileNotFoundError:
        return {}, [Violation(name, "", absent, missing)]
    except (OSError, ValueError) as error:
        return {}, [Violation(name, "", expected, one_line(error))]
    if not isinstance(content, dict):
        return {}, [Violation(name, "", "an object", type(content).__name__)]
    return content, check_form(model, content, name) if model else []


def check_form(model: type[BaseModel], content: Mapping[str, Any], file: str) -> list[Violation]:
    """Compare the content of a JSON file with its declared form."""
    try:
        model.model_validate(content)
    except ValidationError as error:
        found: dict[str, Violation] = {}  # only the first faulty item of each list
        for mistake in mistakes(error, words=_WORDS):
            key = ".".join(word for word in mistake.key.split(".") if not word.isdecimal())
            found.setdefault(key, _violation(file, mistake))
        return list(found.values())
    return []


def _violation(file: str, mistake: Mistake) -> Violation:
    if mistake.kind in ("too_short", "too_long"):
        limit = mistake.context.get("min_length", mistake.context.get("max_length"))
        return Violation(file, mistake.key, f"{limit} values", f"{mistake.context['actual_length']}")
    found = "no such key" if mistake.kind == "missing" else shorten(mistake.value)
    return Violation(file, mistake.key, mistake.expected or mistake.what.removeprefix(f"{mistake.key}: "), found)


def shorten(value: Any) -> str:
    """Return a JSON value in at most 60 characters."""
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."
