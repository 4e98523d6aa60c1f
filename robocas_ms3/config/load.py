"""Find and read task configurations; every mistake in a file becomes one line that names file, key, expected, found."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from robocas_ms3.benchmark import TaskSpec
from robocas_ms3.config.supports import SUPPORTS
from robocas_ms3.config.task import TaskConfig
from robocas_ms3.documents import DocumentError, load_yaml
from robocas_ms3.errors import ConfigError
from robocas_ms3.paths import task_configs_dir
from robocas_ms3.strict import nearest, parse

_log = logging.getLogger(__name__)


def shipped_configs() -> dict[str, Path]:
    """Name -> file of the configurations that travel with the package."""
    return {path.stem: path for path in sorted(task_configs_dir().glob("*.yaml"))}


def load_config_of(spec: TaskSpec, config: str | Path | dict | TaskConfig | None = None) -> TaskConfig:
    """Read a configuration of a task.

    Args:
        spec: of the task.
        config: see `load_task_config`; None: the task's default.

    Raises:
        ConfigError: it is wrong, or another task's.
    """
    loaded = load_task_config(spec.default_config if config is None else config)
    if loaded.task != spec.name:
        name = f" {config}" if isinstance(config, str) else ""
        raise ConfigError(
            f"{spec.env_id} can't run the configuration{name}",
            expected=f"task: {spec.name}",
            found=f"task: {loaded.task}",
        )
    return loaded


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
        data = load_yaml(path)
    except DocumentError as error:
        raise ConfigError("this is not valid YAML", where=path, found=error) from error
    except OSError as error:
        raise ConfigError("can't read this file", where=path, found=error.strerror) from error
    parsed = parse_task_config(data, where=str(path))
    if parsed.support not in SUPPORTS:
        _log.warning(
            "%s: texts know no support %r: they say 'on the %s' and no synonyms; known are %s",
            *(path, parsed.support, parsed.support, ", ".join(SUPPORTS)),
        )
    return parsed


def parse_task_config(data: Any, *, where: str) -> TaskConfig:
    """Check a mapping against the declared form.

    Raises:
        ConfigError: for the first mistake; the count of further ones is in the message.
    """
    if not isinstance(data, dict):
        raise ConfigError("a task configuration is a mapping", where=where, found=type(data).__name__)
    return parse(TaskConfig, data, ConfigError, where=where)


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
