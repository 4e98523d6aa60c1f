"""The ``robocas`` command: finds the subcommand, turns what goes wrong into one line and an exit code."""

from __future__ import annotations

import errno
import importlib
import logging
import operator
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import fields
from functools import reduce
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, TextIO

import tyro

from robocas_ms3 import __version__
from robocas_ms3.errors import RobocasError

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
    "eval",
    "serve-policy",
)
DESCRIPTION = (
    "RoboCAS for ManiSkill3: demonstrations and datasets of manipulation in complex object arrangements. "
    "`robocas COMMAND --help` explains a command; --debug with any of them shows tracebacks."
)
CLI_STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
INTERRUPTED = 130  # what a shell reports of a program that Ctrl-C ended
_FULL = {errno.ENOSPC, errno.EDQUOT}
_ENVIRONMENT = {*_FULL, errno.EACCES, errno.EPERM, errno.EROFS}


def main(argv: Sequence[str] | None = None) -> None:
    """Run ``robocas`` and leave the process with its exit code.

    Args:
        argv: arguments after the program's name; default: the process's own.
    """
    sys.exit(run(sys.argv[1:] if argv is None else argv))


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
    except OSError as error:
        if debug or error.errno not in _ENVIRONMENT:
            raise
        where = f"{error.filename}: " if error.filename else ""
        return _say(f"error: {where}{os.strerror(error.errno)}{_room(error, arguments[0])}", sys.stderr, 1)


def _dispatch(arguments: list[str]) -> int:
    if arguments and arguments[0] in COMMANDS:  # only the command that is asked for is imported
        name, rest = arguments[0], arguments[1:]
        module = module_of(name)
        cfg = tyro.cli(config_type(module, name), prog=f"robocas {name}", args=rest, config=CLI_STYLE)
        return module.main(cfg)
    if arguments and not arguments[0].startswith("-"):
        from robocas_ms3.strict import nearest

        fix = nearest(arguments[0], COMMANDS) or f"There are: {', '.join(COMMANDS)}."
        return _say(f"error: {arguments[0]}: no such command. {fix}", sys.stderr, 2)
    modules = {name: module_of(name) for name in COMMANDS}
    choices = [Annotated[config_type(module, name), tyro.conf.subcommand(name)] for name, module in modules.items()]
    choice: Any = reduce(operator.or_, choices)
    tyro.cli(choice, prog="robocas", description=DESCRIPTION, args=arguments or ["--help"], config=CLI_STYLE)
    raise AssertionError("tyro leaves the process on --help and on an unknown command")


def _room(error: OSError, command: str) -> str:
    """How much there is where it does not suffice, and what to do then."""
    if error.errno not in _FULL:
        return ""
    folders = [folder for folder in Path(error.filename or "").absolute().parents if folder.is_dir()]
    free = f" ({shutil.disk_usage(folders[0]).free / 2**20:.0f} MB free)" if error.filename else ""
    of_command = config_type(module_of(command), command)
    goes_on = command == "plan" or any(field.name == "resume" for field in fields(of_command))
    return f"{free}. Make room" + (", then go on with --resume." if goes_on else ".")


def module_of(name: str) -> ModuleType:
    """Module of a command."""
    return importlib.import_module(f"robocas_ms3.cli.{name.replace('-', '_')}")


def config_type(module: ModuleType, name: str) -> type:
    """Dataclass of a command, in its module."""
    return getattr(module, "".join(word.capitalize() for word in name.split("-")))


def _say(text: str, stream: TextIO, code: int) -> int:
    stream.write(text + "\n")
    return code
