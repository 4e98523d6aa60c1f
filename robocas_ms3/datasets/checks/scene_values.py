"""Checks the values of ``scene.json`` and ``conversion.json`` by their declared forms, `sources.records`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from robocas_ms3.core.strict import Mistake, mistakes
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.sources.records import ConversionRecord, RateRecord, SceneRecord

_UNKNOWN = {**dict.fromkeys(schema.SCENE), "schema_version": schema.SCHEMA_VERSION, "rate_hz": 1.0, "source": {}}
_WORDS = {
    "int_type": "an integer",
    "string_type": "text",
    "dict_type": "an object",
    "model_type": "an object",
}  # JSON's


def check_values(scene: Mapping[str, Any], file: str = schema.SCENE_FILE) -> list[Violation]:
    """What is wrong with a ``scene.json``: keys that are missing, values of another kind, places that contradict ids.

    Args:
        scene: its content.
        file: it is in.
    """
    wrong = check_form(SceneRecord, scene, file)
    if wrong:
        return wrong
    layout = scene["layout"] or {}
    count = len(layout.get("object_ids", ()))
    return [
        Violation(file, f"layout.{key}", f"{count}, as many as object_ids", str(len(layout[key])))
        for key in ("poses", "present")
        if len(layout.get(key, ())) not in (0, count)
    ]


def check_settings_values(settings: Mapping[str, Any]) -> list[Violation]:
    """What is wrong with the values of a ``conversion.json``."""
    return check_form(ConversionRecord, settings, schema.CONVERSION_FILE)


def check_rate(content: Mapping[str, Any]) -> list[Violation]:
    """What is wrong with ``rate_hz``, which both files have."""
    return check_form(RateRecord, content, "")


def sound(scene: Any, file: str = schema.SCENE_FILE) -> tuple[dict[str, Any], str]:
    """What of a ``scene.json`` can be used, and what is wrong with the rest; a missing key is nothing wrong here."""
    if not isinstance(scene, Mapping):
        return {}, "" if scene is None else f"{file}: expected an object, found {_shown(scene)}"
    wrong = check_values({**_UNKNOWN, **scene}, file)
    spoilt = {violation.key.partition(".")[0] for violation in wrong}
    return {key: value for key, value in scene.items() if key not in spoilt}, "; ".join(map(str, wrong))


def check_form(model: type[BaseModel], content: Mapping[str, Any], file: str) -> list[Violation]:
    """Return how the content of a JSON file differs from a declared form."""
    try:
        model.model_validate(content)
    except ValidationError as error:
        found: dict[str, Violation] = {}  # by key; of a list's items the first one says it all
        for mistake in mistakes(error, words=_WORDS):
            key = ".".join(word for word in mistake.key.split(".") if not word.isdecimal())
            found.setdefault(key, _violation(file, mistake))
        return list(found.values())
    return []


def _violation(file: str, mistake: Mistake) -> Violation:
    if mistake.kind in ("too_short", "too_long"):
        limit = mistake.context.get("min_length", mistake.context.get("max_length"))
        return Violation(file, mistake.key, f"{limit} values", f"{mistake.context['actual_length']}")
    found = "no such key" if mistake.kind == "missing" else _shown(mistake.value)
    return Violation(file, mistake.key, mistake.expected or mistake.what.removeprefix(f"{mistake.key}: "), found)


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."
