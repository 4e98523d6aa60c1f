"""Load task configurations. An invalid one is an error that names file, key, expected and found value."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import YAML_LIMIT, DocumentError, load_yaml, read_text
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.paths import task_configs_dir
from robocas_ms3.core.strict_model import did_you_mean, parse
from robocas_ms3.scenes.config.compose import EXTENDS, Composition, parse_set_option
from robocas_ms3.scenes.config.task import TaskConfig
from robocas_ms3.scenes.language.texts import load_synonym_texts
from robocas_ms3.scenes.task_specs import TASKS, TaskSpec

CHAIN_LIMIT = 8
"""Greatest number of files of a configuration and its bases."""
_SUFFIXES = (".yaml", ".yml")
_log = logging.getLogger(__name__)


def bundled_configs() -> dict[str, Path]:
    """Return the path of each bundled configuration by its name."""
    return {path.stem: path for path in sorted(task_configs_dir().glob("*.yaml"))}


def load_config_for(
    spec: TaskSpec, config: str | Path | dict | TaskConfig | None = None, *, usage: bool = False
) -> TaskConfig:
    """Load a task configuration, and check that it belongs to a task.

    Args:
        spec: the task.
        config: as in `load_task_config`; default: the default configuration of the task.
        usage: whether the user chose the configuration for this task, see `RobocasError`.

    Raises:
        ConfigError: the configuration is invalid, or belongs to another task.
    """
    loaded = load_task_config(spec.default_config if config is None else config)
    if loaded.task != spec.name:
        name = f" {config}" if isinstance(config, str) else ""
        what = f"{spec.env_id} can't run the configuration{name}"
        fix = "Choose a configuration of this task: `robocas list`."
        raise ConfigError(what, expected=f"task: {spec.name}", found=f"task: {loaded.task}", fix=fix, usage=usage)
    return loaded


def load_task_config(
    config: str | Path | dict | TaskConfig, changes: Mapping[str, Any] | None = None, set_options: Sequence[str] = ()
) -> TaskConfig:
    """Load a task configuration; warn about a ``support`` that is not in ``synonyms.yaml``.

    Args:
        config: name of a bundled configuration (``pick_table_scattered``), path of a YAML file, a mapping of the same
            form, or a loaded configuration. Only files may have the key ``extends``.
        changes: mapping of changed keys, nested as in the YAML file: ``{"objects": {"count": 12}}``.
        set_options: the same in the form of the command line option ``--set``: strings ``objects.count=12``; they
            have priority over ``changes``.

    Raises:
        ConfigError: the file does not exist or is not YAML, files extend each other in a cycle, or a key or value is
            invalid.
    """
    if isinstance(config, TaskConfig):
        if not changes and not set_options:
            return config
        config = config.model_dump(mode="json")
    composition = Composition()
    if isinstance(config, dict):
        label = "config"
        composition.merge(config, label, removes=False)
    else:
        label = _merge_file(composition, config)
    sources = {"changes": changes} if changes else {}
    sources |= {f"--set {text}": parse_set_option(text, ConfigError, "objects.count=12") for text in set_options}
    for source, values in sources.items():
        composition.merge(values, source)
    label = f"{label} with {', '.join(sources)}" if sources else label
    where = partial(composition.source_of, default=label)
    parsed = parse(TaskConfig, composition.values, ConfigError, where=where)
    supports = load_synonym_texts().supports
    if parsed.support not in supports and not isinstance(config, dict):
        message = "%s: no synonyms for the support %r; instructions contain 'on the %s' (supports with synonyms: %s)"
        _log.warning(message, where("support"), parsed.support, parsed.support, ", ".join(sorted(supports)))
    return parsed


def check_no_extends(path: Path) -> None:
    """Raise ConfigError if a configuration file of a frozen protocol has the key ``extends``."""
    try:
        text = read_text(path, YAML_LIMIT)
    except (OSError, DocumentError) as error:
        raise ConfigError("can't read the configuration", where=path, found=error) from error
    if EXTENDS not in text and "\\" not in text:  # parsing is slow; the key may be written with escapes
        return
    data = _read(path)
    if EXTENDS in data:
        found, fix = f"{EXTENDS}: {data[EXTENDS]}"[:80], "Freeze the protocol again: robocas eval freeze."
        what = f"{EXTENDS!r} is not allowed in a protocol"
        raise ConfigError(what, where=path, expected="a complete configuration", found=found, fix=fix)


def _merge_file(composition: Composition, config: str | Path) -> str:
    """Merge a file over the files that it extends; return the name of the file for messages."""
    chain = _read_chain(_find_file(config))
    first = str(chain[0][0])
    for number, (path, data) in reversed(list(enumerate(chain))):
        source = f"{path} (extended by {chain[number - 1][0]})" if number else first
        composition.merge(data, source, removes=path != chain[-1][0])
    bases = ", ".join(str(path) for path, _ in chain[1:])
    return f"{first} (extends {bases})" if bases else first


def _read_chain(path: Path) -> list[tuple[Path, dict[Any, Any]]]:
    """Read a file, the file that it extends, and so on, in this order; keys ``extends`` are removed."""
    chain: list[tuple[Path, dict[Any, Any]]] = []
    found: Path | None = path
    while found is not None:
        path, data = found, _read(found)
        files = [*(str(before) for before, _ in chain), str(path)]
        where = f"{path}, {EXTENDS}"
        if any(before.resolve() == path.resolve() for before, _ in chain):
            where = f"{chain[-1][0]}, {EXTENDS}"
            raise ConfigError(
                "configurations extend each other in a cycle",
                where=where,
                found=" -> ".join(files),
                fix="Remove one of these keys.",
            )
        if len(chain) == CHAIN_LIMIT:
            expected = f"at most {CHAIN_LIMIT} files"
            fix = "Copy the keys of some base configurations into the files that extend them."
            raise ConfigError(
                f"too many configurations extend each other, from {files[0]} on",
                where=where,
                expected=expected,
                fix=fix,
            )
        found = None
        if EXTENDS in data:
            named = data.pop(EXTENDS)
            if not isinstance(named, str) or not named:
                what, expected = f"invalid value for {EXTENDS!r}", "the name of a bundled configuration or a YAML file"
                raise ConfigError(what, where=where, expected=expected, found=repr(named)[:80])
            found = _find_file(named, path.parent, where)
        chain.append((path, data))
    return chain


def _read(path: Path) -> dict[Any, Any]:
    try:
        data = load_yaml(path)
    except DocumentError as error:
        raise ConfigError("the configuration is not valid YAML", where=path, found=error) from error
    except OSError as error:
        raise ConfigError("can't read the configuration", where=path, found=error.strerror) from error
    if not isinstance(data, dict):
        what = "the file is not a task configuration"
        raise ConfigError(what, where=path, expected="a mapping of keys to values", found=type(data).__name__)
    for key in data:
        if key != EXTENDS and key not in TaskConfig.model_fields and (likely := did_you_mean(str(key), [EXTENDS])):
            expected = f"one of {', '.join([EXTENDS, *sorted(TaskConfig.model_fields)])}"
            raise ConfigError(f"unknown key {key!r}", where=path, expected=expected, fix=likely)
    return data


def _find_file(config: str | Path, folder: Path | None = None, where: str = "") -> Path:
    """Return the file of a bundled configuration or of a path, which is relative to ``folder`` if given."""
    configs, name = bundled_configs(), str(config)
    if name in configs:
        return configs[name]
    if folder is None and name in TASKS:
        what = f"{name} is a task, not a task configuration"
        fix = f"Its default configuration is {TASKS[name].default_config}; all names: `robocas list`."
        raise ConfigError(what, fix=fix, usage=True)
    path = Path(config) if folder is None else folder / config
    is_yaml = path.suffix in _SUFFIXES
    with suppress(OSError, ValueError):  # such as a name that is too long
        if is_yaml and path.is_file():
            return path
    likely = did_you_mean(path.stem if is_yaml else name, configs)
    what, expected = "no such task configuration", "a YAML file (.yaml, .yml) or a bundled configuration"
    if folder is not None:
        files = [str(path.relative_to(folder)) for end in _SUFFIXES for path in sorted(folder.glob(f"*{end}"))]
        expected = f"a bundled configuration or a YAML file (.yaml, .yml) relative to {folder}"
        what = "no such base configuration"
        likely = did_you_mean(name, [*configs, *files]) or did_you_mean(f"{name}.yaml", files) or likely
    if is_yaml and not likely:
        raise ConfigError(
            "no such configuration file", where=where or name, expected=expected, found=path.absolute(), usage=not where
        )
    raise ConfigError(
        what,
        where=where or name,
        expected=expected + ("" if likely else f": {', '.join(sorted(configs))}"),
        found=repr(name) if where else "",
        fix=f"{likely} All names: `robocas list`." if likely else "",
        usage=not where,
    )
