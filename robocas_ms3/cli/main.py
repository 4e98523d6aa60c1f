"""The ``robocas`` command: parse the words, run the command, turn an error into one line and an exit code."""

from __future__ import annotations

import errno
import importlib
import logging
import operator
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, NoReturn, TextIO, get_type_hints

import platformdirs
import tyro

from robocas_ms3 import __version__
from robocas_ms3.cli.options import with_absolute_paths
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.files import DISK_FULL_ERRNOS
from robocas_ms3.core.paths import ensure_home, is_writable, temporary_cache, variable_of
from robocas_ms3.core.signals import INTERRUPTED, exit_command, forbid_exit, handle_interrupts
from robocas_ms3.core.text import escape_controls, escape_log_lines, escape_tracebacks

# Each is a module next to this one (import-robocas: import_robocas.py) with a function `main(cfg: Settings) -> int`. A
# command with commands of its own has instead `COMMANDS`, such functions by name, `DESCRIPTION` and perhaps `DEFAULT`.
COMMANDS = (
    "doctor",
    "list",
    "show",
    "generate",
    "replay",
    "convert",
    "validate",
    "video",
    "view",
    "stats",
    "merge",
    "split",
    "import-robocas",
    "assets",
    "layouts",
    "plan",
    "train",
    "eval",
    "serve-policy",
)
DESCRIPTION = (
    "RoboCAS for ManiSkill3: demonstrations and datasets of manipulation in complex object arrangements. "
    "`robocas COMMAND --help` explains a command; --debug with any of them shows tracebacks."
)
CLI_STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.DisallowNone)
# What the system says of disks, file servers, names and limits, which no traceback explains
_ENVIRONMENT = {
    *DISK_FULL_ERRNOS,
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENAMETOOLONG),
    *(errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH),
    *(errno.EMFILE, errno.ENFILE),
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run ``robocas`` and leave the process with its exit code; default arguments: the process's own."""
    escape_tracebacks()
    handle_interrupts()
    exit_command(run(sys.argv[1:] if argv is None else argv))


def run(argv: Sequence[str]) -> int:
    """Run ``robocas``; return its exit code: 0, 1 for a failure (one line on stderr), 2 for an invalid option.

    ``--debug`` among the arguments gives tracebacks.
    """
    arguments = [word for word in argv if word != "--debug"]
    debug = len(arguments) < len(argv) or os.environ.get("ROBOCAS_DEBUG", "0") not in {"", "0"}
    if arguments[:1] == ["--version"]:
        return _say(f"robocas {__version__}", sys.stdout, 0)
    if not debug:
        # ManiSkill's logger (the blank is in its name) remarks on its own installation, and on CPUs without a GPU.
        logging.getLogger("mani_skill ").addFilter(lambda record: record.levelno >= logging.ERROR)
        logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)  # it says that it looks for fonts
    escape_log_lines()
    try:
        command, settings = parse(arguments)
        _lend_folders()
        with forbid_exit(f"robocas {arguments[0]}"):
            return command(with_absolute_paths(settings))
    except KeyboardInterrupt as interrupt:  # a command may say how to go on
        return _say("; ".join(["interrupted", *map(str, interrupt.args)]), sys.stderr, INTERRUPTED)
    except BrokenPipeError:
        # The reader went away (`robocas list | head`); whatever Python flushes on exit has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except RobocasError as error:
        if debug:
            raise
        of_option = str(error.where).startswith("--")
        return _say(f"error: {' '.join(str(error).split())}", sys.stderr, 2 if of_option else 1)
    except ValueError as error:
        from robocas_ms3.core.documents import (
            DocumentError,  # with YAML, which no command waits for that fails otherwise
        )

        if debug or not isinstance(error, DocumentError):
            raise
        where = f"{error.filename}: " if error.filename else ""
        return _say(f"error: {where}{' '.join(str(error).split())}", sys.stderr, 1)
    except OSError as error:
        if debug or error.errno not in _ENVIRONMENT:
            raise
        where = f"{error.filename}: " if error.filename else ""
        return _say(f"error: {where}{os.strerror(error.errno)}{_remedy(error)}", sys.stderr, 1)


def parse(words: Sequence[str]) -> tuple[Callable[[Any], int], Any]:
    """Parse a command line without running it; only the module of its command is imported.

    Return the function of the command and its settings. SystemExit: help was printed (0), or the words are wrong (2).
    """
    if not words or words[0] not in COMMANDS:
        commands = {name: module_of(name) for name in COMMANDS}
        _print_help("robocas", DESCRIPTION, commands, words)
    module, prog, rest = module_of(words[0]), f"robocas {words[0]}", list(words[1:])
    if not hasattr(module, "COMMANDS"):
        return module.main, tyro.cli(settings_type(module.main), prog=prog, args=rest, config=CLI_STYLE)
    commands, default = module.COMMANDS, getattr(module, "DEFAULT", None)
    if default and not (rest and rest[0] in (*commands, "-h", "--help")) and _takes(commands[default], rest):
        rest = [default, *rest]
    if not rest or rest[0] not in commands:
        _print_help(prog, module.DESCRIPTION, commands, rest)
    command, prog = commands[rest[0]], f"{prog} {rest[0]}"
    return command, tyro.cli(settings_type(command), prog=prog, args=rest[1:], config=CLI_STYLE)


def module_of(name: str) -> ModuleType:
    return importlib.import_module(f"robocas_ms3.cli.{name.replace('-', '_')}")


def settings_type(command: Callable[[Any], int]) -> type:
    """Return the dataclass that the function of a command takes: its options."""
    (parameter, *_) = get_type_hints(command).values()
    return parameter


def _takes(command: Callable[[Any], int], words: Sequence[str]) -> bool:
    """Return whether words may belong to a command: they start with an option, or it has positional arguments."""
    types = get_type_hints(settings_type(command), include_extras=True).values()
    positional = any(tyro.conf.Positional in getattr(found, "__metadata__", ()) for found in types)
    return positional or not words or words[0].startswith("-")


@dataclass
class _Group:
    """Commands of a command, in the overview."""


def _print_help(prog: str, description: str, commands: Mapping[str, Any], words: Sequence[str]) -> NoReturn:
    """Print the overview of some commands, or that there is no such command among them."""
    rows = []
    for name, command in commands.items():
        of_group = getattr(command, "DESCRIPTION", None)
        settings = _Group if of_group else settings_type(getattr(command, "main", command))
        rows.append(Annotated[settings, tyro.conf.subcommand(name, description=of_group)])
    choice: Any = reduce(operator.or_, rows)
    tyro.cli(choice, prog=prog, description=description, args=words or ["--help"], config=CLI_STYLE)
    raise AssertionError("tyro leaves the process on --help and on an unknown command")


def _lend_folders() -> None:
    """Give libraries that only want a place to write one, where theirs is missing or read-only."""
    ensure_home()
    places = {
        "MPLCONFIGDIR": platformdirs.user_config_path("matplotlib"),
        "MESA_SHADER_CACHE_DIR": platformdirs.user_cache_path("mesa_shader_cache"),
    }
    for variable, usual in places.items():
        if variable not in os.environ and not is_writable(usual) and (folder := temporary_cache()):
            os.environ[variable] = str(folder / usual.name)


def _remedy(error: OSError) -> str:
    """Return how much space is free where it does not suffice, and what to do."""
    variable = variable_of(error.filename) if error.filename else ""
    if error.errno not in DISK_FULL_ERRNOS:
        return f". Set {variable} to a folder that can be written to." if variable else ""
    folders = [folder for folder in Path(error.filename or "").absolute().parents if folder.is_dir()]
    free = f" ({shutil.disk_usage(folders[0]).free / 2**20:.0f} MB free)" if error.filename else ""
    elsewhere = f", or set {variable} to a folder that has some" if variable else ""
    return f"{free}. Make room{elsewhere}, then run the command again."


def _say(text: str, stream: TextIO, code: int) -> int:
    stream.write(escape_controls(text) + "\n")
    return code
