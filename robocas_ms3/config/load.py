"""Find and read task configurations; every mistake in a file becomes one line that names file, key, expected, found."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from robocas_ms3.config.supports import SUPPORTS
from robocas_ms3.config.task import TaskConfig
from robocas_ms3.errors import ConfigError
from robocas_ms3.paths import task_configs_dir

_log = logging.getLogger(__name__)

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


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML in which a key given twice is an error, not the last one silently winning."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """Build a mapping, refusing repeated keys."""
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=deep)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


def shipped_configs() -> dict[str, Path]:
    """Name -> file of the configurations that travel with the package."""
    return {path.stem: path for path in sorted(task_configs_dir().glob("*.yaml"))}


def load_task_config(config: str | Path | dict | TaskConfig) -> TaskConfig:
    """Read a task configuration. A file whose ``support`` is not of ``SUPPORTS`` gets a warning.

    Args:
        config: name of a shipped configuration (``pick_table_scattered``), path of a YAML file, a mapping of the same
            form, or a configuration that is loaded already.

    Raises:
        ConfigError: no such file, not YAML, an unknown key, a wrong type or value.
    """
    if isinstance(config, TaskConfig):
        return config
    if isinstance(config, dict):
        return parse_task_config(config, where="config")
    path = _find(config)
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)  # noqa: S506  (a SafeLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError("this is not valid YAML", where=path, found=" ".join(str(error).split())) from error
    except OSError as error:
        raise ConfigError("can't read this file", where=path, found=error.strerror) from error
    parsed = parse_task_config(data, where=str(path))
    if parsed.support not in SUPPORTS:
        _log.warning(
            "%s: texts know no support %r: they say 'on the %s' and no synonyms; known are %s",
            *(path, parsed.support, parsed.support, ", ".join(SUPPORTS)),
        )
    return parsed


def nearest(name: str, known: Iterable[str]) -> str:
    """A question that names the known words most like a wrong one, best first; empty where none is like it."""
    found = get_close_matches(name, list(known), n=3, cutoff=0.7)
    return f"Did you mean {' or '.join(found)}?" if found else ""


def parse_task_config(data: Any, *, where: str) -> TaskConfig:
    """Check a mapping against the declared form.

    Raises:
        ConfigError: for the first mistake; the count of further ones is in the message.
    """
    if not isinstance(data, dict):
        raise ConfigError("a task configuration is a mapping", where=where, found=type(data).__name__)
    try:
        # JSON mode: strict about types, yet lists serve as tuples and whole numbers as floats, as in YAML
        return TaskConfig.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        raise _config_error(error, where) from error
    except TypeError as error:
        raise ConfigError("a value here has no place in a configuration", where=where, found=error) from error


def _config_error(error: ValidationError, where: str) -> ConfigError:
    mistakes = [(*_place(mistake["loc"]), mistake) for mistake in error.errors(include_url=False)]
    keys, node, first = mistakes[0]
    kind, key = first["type"], ".".join(keys) or "(top level)"
    # what may be of several types has a mistake for each, at its own place or further out
    others = {".".join(other) for other, *_ in mistakes if other != keys[: len(other)]}
    more = f"{len(others)} more after this one." if others else ""
    found = "nothing" if kind == "missing" else repr(first["input"])
    if len(found) > _FOUND_LENGTH:
        found = found[:_FOUND_LENGTH] + "..."
    if kind == "extra_forbidden":
        name, known = str(first["loc"][-1]), sorted(_place(first["loc"][:-1])[1].get("properties", {}))
        return ConfigError(
            f"unknown key {key!r}",
            where=where,
            expected=f"one of {known}" if known else "no such key",
            found=repr(name),
            fix=f"{nearest(name, known)} {more}".strip(),
        )
    if kind in {"union_tag_invalid", "union_tag_not_found"}:
        tag, kinds = node["discriminator"]["propertyName"], sorted(node["discriminator"]["mapping"])
        said = str(first.get("ctx", {}).get("tag", ""))
        return ConfigError(
            f"wrong value for '{key}.{tag}'",
            where=where,
            expected=f"one of {kinds}",
            found=repr(said) if said else "nothing",
            fix=f"{nearest(said, kinds)} {more}".strip(),
        )
    if kind == "value_error":
        what = first["msg"].removeprefix("Value error, ")
        return ConfigError(f"{key}: {what}" if keys else what, where=where, fix=more)
    expected = dict.fromkeys(_expected(mistake) for other, _, mistake in mistakes if other == keys)
    return ConfigError(f"wrong value for {key!r}", where=where, expected=" or ".join(expected), found=found, fix=more)


def _expected(mistake: Any) -> str:
    kind, place = mistake["type"], mistake["loc"]
    if kind == "missing" and place and isinstance(place[-1], int):
        return f"at least {place[-1] + 1} items in this list"
    said = re.sub(r"^(Input|List|Tuple|Dictionary) should (be|have) | after validation", "", mistake["msg"])
    return _EXPECTED.get(kind, said)


def _place(location: tuple[int | str, ...]) -> tuple[list[str], dict[str, Any]]:
    """Where a mistake is, for messages.

    Returns:
        The keys that lead there, as the file has them (pydantic adds the kind where a block comes in several, and the
        type where a value may be of several), and the JSON schema of what belongs there; empty where it is not known.
    """
    schema = TaskConfig.model_json_schema()
    node: dict[str, Any] = schema
    keys: list[str] = []
    for part in location:
        kinds = node.get("discriminator", {}).get("mapping", {})
        choices = node.get("anyOf", ())
        if part in kinds:
            node = {"$ref": kinds[part]}
        elif choices:
            node = next((choice for choice in choices if choice.get("type") == "array"), {})
        else:
            keys.append(str(part))
            inner = node.get("properties", {}).get(part) or node.get("additionalProperties") or node.get("items")
            node = inner if isinstance(inner, dict) else {}
        real = [choice for choice in node.get("anyOf", ()) if choice.get("type") != "null"]
        node = real[0] if len(real) == 1 else node  # X | None
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
    return keys, node


def _find(config: str | Path) -> Path:
    shipped = shipped_configs()
    name = str(config)
    if name in shipped:
        return shipped[name]
    path = Path(config)
    if path.suffix in {".yaml", ".yml"} and path.is_file():
        return path
    likely = nearest(path.stem if path.suffix in {".yaml", ".yml"} else name, shipped)
    raise ConfigError(
        "no such task configuration",
        where=name,
        expected="a YAML file (.yaml, .yml) or a shipped name" + ("" if likely else f": {', '.join(sorted(shipped))}"),
        fix=f"{likely} `robocas list` has all names." if likely else "",
    )
