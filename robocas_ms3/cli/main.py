"""The ``robocas`` command: finds the subcommand, turns what goes wrong into one line and an exit code."""

from __future__ import annotations

import errno
import importlib
import logging
import operator
import os
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import fields
from functools import reduce
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, TextIO, get_args, get_type_hints

import platformdirs
import tyro

from robocas_ms3 import __version__
from robocas_ms3.cli.absolute import with_absolute_paths
from robocas_ms3.cli.interrupts import INTERRUPTED, heed_ctrl_c, leave
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.exits import no_exit
from robocas_ms3.core.files import FULL
from robocas_ms3.core.paths import ensure_home, is_writable, temporary_cache, variable_of
from robocas_ms3.core.words import escape_log_lines, escape_tracebacks, printable

# Each names a module beside this one, with a dataclass called as the command and `main(cfg) -> int`; a dash in its name
# is an underscore in the module's: import-robocas, import_robocas.py, ImportRobocas.
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
    *FULL,
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENAMETOOLONG),
    *(errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH),
    *(errno.EMFILE, errno.ENFILE),
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run ``robocas`` and leave the process with its exit code.

    Args:
        argv: arguments after the program's name; default: the process's own.
    """
    escape_tracebacks()
    heed_ctrl_c()
    leave(run(sys.argv[1:] if argv is None else argv))


def run(argv: Sequence[str]) -> int:
    """Run ``robocas`` and give its exit code: 0, 1 for a failure (one line on stderr), 2 for wrong arguments.

    Args:
        argv: arguments after the program's name. ``--debug`` anywhere gives tracebacks.
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
        return _dispatch(arguments)
    except KeyboardInterrupt as interrupt:  # a command may say how to go on
        return _say("; ".join(["interrupted", *map(str, interrupt.args)]), sys.stderr, INTERRUPTED)
    except BrokenPipeError:
        # The reader went away (`robocas list | head`); whatever Python flushes on exit has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except RobocasError as error:
        if debug:
            raise
        return _say(f"error: {' '.join(str(error).split())}", sys.stderr, 1)
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
        return _say(f"error: {where}{os.strerror(error.errno)}{_room(error)}", sys.stderr, 1)


def _dispatch(arguments: list[str]) -> int:
    if arguments and arguments[0] in COMMANDS:  # only the command that is asked for is imported
        name, rest = arguments[0], arguments[1:]
        module = module_of(name)
        of_command = config_type(module, name)
        known = subcommands(of_command)
        if known and rest and not rest[0].startswith("-") and rest[0] not in known:
            return _unknown(rest[0], f"command of robocas {name}", known)
        if wrong := _misspelt(of_command, known, f"robocas {name}", rest):
            return _say(f"error: {wrong}", sys.stderr, 2)
        cfg = tyro.cli(of_command, prog=f"robocas {name}", args=rest, config=CLI_STYLE)
        _lend_folders()
        with no_exit(f"robocas {name}"):
            return module.main(with_absolute_paths(cfg))
    if arguments and not arguments[0].startswith("-"):
        return _unknown(arguments[0], "command", COMMANDS)
    modules = {name: module_of(name) for name in COMMANDS}
    choices = [Annotated[config_type(module, name), tyro.conf.subcommand(name)] for name, module in modules.items()]
    choice: Any = reduce(operator.or_, choices)
    tyro.cli(choice, prog="robocas", description=DESCRIPTION, args=arguments or ["--help"], config=CLI_STYLE)
    raise AssertionError("tyro leaves the process on --help and on an unknown command")


def subcommands(of_command: type) -> dict[str, type]:
    """Dataclasses of a command's own commands by name; empty where it has none."""
    if "command" not in {field.name for field in fields(of_command)}:
        return {}
    choices = map(get_args, get_args(get_type_hints(of_command, include_extras=True)["command"]))
    return {about.name: dataclass for dataclass, about in choices}


def _misspelt(of_command: type, known: dict[str, type], prog: str, words: list[str]) -> str:
    if not words or {"-h", "--help"} & set(words):
        return ""
    from robocas_ms3.cli.spelling import misspelt

    if not known:
        return misspelt(of_command, prog, words)
    return misspelt(known[words[0]], f"{prog} {words[0]}", words[1:]) if words[0] in known else ""


def _unknown(word: str, what: str, known: Iterable[str]) -> int:
    from robocas_ms3.core.strict import nearest

    fix = nearest(word, known) or f"There are: {', '.join(known)}."
    return _say(f"error: {word}: no such {what}. {fix}", sys.stderr, 2)


def _lend_folders() -> None:
    """Give libraries that only want a place to write one, where theirs is missing or read-only.

    Raises:
        RobocasError: see `ensure_home`.
    """
    ensure_home()
    places = {
        "MPLCONFIGDIR": platformdirs.user_config_path("matplotlib"),
        "MESA_SHADER_CACHE_DIR": platformdirs.user_cache_path("mesa_shader_cache"),
    }
    for variable, usual in places.items():
        if variable not in os.environ and not is_writable(usual) and (folder := temporary_cache()):
            os.environ[variable] = str(folder / usual.name)


def _room(error: OSError) -> str:
    """How much there is where it does not suffice, and what to do then."""
    variable = variable_of(error.filename) if error.filename else ""
    if error.errno not in FULL:
        return f". Set {variable} to a folder that can be written to." if variable else ""
    folders = [folder for folder in Path(error.filename or "").absolute().parents if folder.is_dir()]
    free = f" ({shutil.disk_usage(folders[0]).free / 2**20:.0f} MB free)" if error.filename else ""
    elsewhere = f", or set {variable} to a folder that has some" if variable else ""
    return f"{free}. Make room{elsewhere}, then run the command again."


def module_of(name: str) -> ModuleType:
    """Module of a command."""
    return importlib.import_module(f"robocas_ms3.cli.{name.replace('-', '_')}")


def config_type(module: ModuleType, name: str) -> type:
    """Dataclass of a command, in its module."""
    return getattr(module, "".join(word.capitalize() for word in name.split("-")))


def _say(text: str, stream: TextIO, code: int) -> int:
    stream.write(printable(text) + "\n")
    return code
