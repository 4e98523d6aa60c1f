"""Find and read task configurations; every mistake in a file becomes one line that names file, key, expected, found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from robocas_ms3.config.task import TaskConfig
from robocas_ms3.errors import ConfigError
from robocas_ms3.paths import task_configs_dir

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
    "union_tag_not_found": "a mapping with its kind",
}


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
    """Read a task configuration.

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
    return parse_task_config(data, where=str(path))


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
    mistakes = error.errors(include_url=False)
    first = mistakes[0]
    key = ".".join(_place(first["loc"])[0]) or "(top level)"
    kind = first["type"]
    more = f"{len(mistakes) - 1} more after this one." if len(mistakes) > 1 else ""
    if kind == "extra_forbidden":
        known = _place(first["loc"][:-1])[1]
        return ConfigError(
            f"unknown key {key!r}",
            where=where,
            expected=f"one of {known}" if known else "no such key",
            found=repr(first["loc"][-1]),
            fix=more,
        )
    if kind == "value_error":
        return ConfigError(f"{key}: {first['msg'].removeprefix('Value error, ')}", where=where, fix=more)
    found = "nothing" if kind == "missing" else repr(first["input"])
    expected = _EXPECTED.get(kind, first["msg"].removeprefix("Input should be "))
    return ConfigError(f"wrong value for {key!r}", where=where, expected=expected, found=found, fix=more)


def _place(location: tuple[int | str, ...]) -> tuple[list[str], list[str]]:
    """Where a mistake is, for messages.

    Returns:
        The keys that lead there, as the file has them (pydantic adds the kind where a block comes in several), and the
        keys allowed there; none where the place isn't a model.
    """
    schema = TaskConfig.model_json_schema()
    node: dict = schema
    keys: list[str] = []
    for part in location:
        kinds = node.get("discriminator", {}).get("mapping", {})
        if part in kinds:
            node = {"$ref": kinds[part]}
        else:
            keys.append(str(part))
            node = node.get("properties", {}).get(part) or node.get("additionalProperties") or {}
            node = node if isinstance(node, dict) else {}
        for choice in node.get("anyOf", ()):  # X | None
            node = choice if "$ref" in choice else node
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
    return keys, sorted(node.get("properties", {}))


def _find(config: str | Path) -> Path:
    shipped = shipped_configs()
    name = str(config)
    if name in shipped:
        return shipped[name]
    path = Path(config)
    if path.suffix in {".yaml", ".yml"} and path.is_file():
        return path
    raise ConfigError(
        "no such task configuration",
        where=name,
        expected=f"a YAML file or one of {sorted(shipped)}",
    )
