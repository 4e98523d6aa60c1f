"""Values of ``scene.json`` and ``conversion.json``, declared for `robocas validate` and whoever shows damaged ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, PlainValidator, ValidationError

from robocas_ms3.core.strict import Mistake, mistakes
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.violation import Violation


def one_seed(value: Any) -> int | None:
    """A seed as an integer; ManiSkill writes a list of one. None where it is neither."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if type(value) is int else None


def _seed(value: Any) -> Any:
    if value is not None and one_seed(value) is None:
        raise ValueError("an integer, or a list of one")
    return value


Rate = Annotated[FiniteFloat, Field(gt=0)]
Pose = Annotated[list[FiniteFloat], Field(min_length=7, max_length=7)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")  # further keys are their writer's


class _EnvInfo(_Part):
    env_id: str
    env_kwargs: dict[str, Any]


class _Layout(_Part):
    object_ids: list[str] = []
    poses: list[Pose] = []
    present: list[bool] = []
    robot_pose: Pose | None = None
    basket_pose: Pose | None = None
    relation: str | None = None


class _Object(_Part):
    slot: NonNegativeInt
    id: str
    name: str


class _Target(_Part):
    slot: NonNegativeInt
    asset_id: str
    name: str


class _Source(_Part):
    trajectory: str | None = None
    episode_id: int | None = None
    recording: str | None = None


class _Recovery(_Part):
    range: Annotated[list[int], Field(min_length=2, max_length=2)]
    stage: str
    reason: str


class _Recorded(_Part):
    instruction_template: str | None = None
    relation: str | None = None
    support: str | None = None
    facts: dict[str, Any] | None = None
    attempts: NonNegativeInt | None = None
    recoveries: list[_Recovery] | None = None
    seconds: dict[str, Any] | None = None


class _Rated(_Part):
    rate_hz: Rate


class Settings(_Rated):
    """``conversion.json``."""

    cameras: list[str]
    image_size: Annotated[list[int], Field(min_length=2, max_length=2)] | None
    image_format: str
    depth: bool
    episodes: dict[str, dict[str, Any]] = {}


class Scene(_Part):
    """``scene.json``. None is what nobody knows, as of datasets made elsewhere."""

    schema_version: Literal[schema.SCHEMA_VERSION]  # pyright: ignore[reportInvalidTypeForm]
    task: str | None
    env_info: _EnvInfo | None
    seed: Annotated[Any, PlainValidator(_seed)]
    reset_options: dict[str, Any] | None
    config: dict[str, Any] | None
    layout: _Layout | None
    objects: list[_Object] | None
    target: _Target | None
    success: bool | None
    control_mode: str | None
    control_freq: Rate | None
    rate_hz: Rate
    source: _Source
    recorded: _Recorded | None
    versions: dict[str, Any] | None


_UNKNOWN = {**dict.fromkeys(schema.SCENE), "schema_version": schema.SCHEMA_VERSION, "rate_hz": 1.0, "source": {}}
# JSON's
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
    wrong = check_form(Scene, scene, file)
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
    return check_form(Settings, settings, schema.CONVERSION_FILE)


def check_rate(content: Mapping[str, Any]) -> list[Violation]:
    """What is wrong with ``rate_hz``, which both files have."""
    return check_form(_Rated, content, "")


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
