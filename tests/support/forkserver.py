"""Commands without the seconds that imports take: a process that has imported the package forks for each."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path
from typing import Any

_PROGRAM = """
import os, pickle, runpy, sys, types
answers = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)
import robocas_ms3.cli.main, robocas_ms3.demos.generate, robocas_ms3.evaluation.run, robocas_ms3.tasks.base

def obey(words, folder, said):
    for stream in (1, 2):
        os.dup2(os.open(said[stream - 1], os.O_WRONLY | os.O_TRUNC), stream)
    os.chdir(folder)
    sys.argv = list(words)
    if words[0] == "-c":
        sys.modules["__main__"] = main = types.ModuleType("__main__")
        exec(compile(words[1], "<string>", "exec"), main.__dict__)
    else:
        sys.path[0] = os.path.dirname(words[0])
        runpy.run_path(words[0], run_name="__main__")

while True:
    try:
        order = pickle.load(sys.stdin.buffer)
    except EOFError:
        break
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        code = 0
        try:
            obey(*order)
        except SystemExit as exit:
            code = exit.code if isinstance(exit.code, int) else int(exit.code is not None)
        except BaseException:
            sys.excepthook(*sys.exc_info())
            code = 1
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    pickle.dump(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), answers)
    answers.flush()
os._exit(0)
"""


class ForkServer:
    """Python with the package imported, ready for commands.

    Args:
        path: folders of packages before all others.
    """

    def __init__(self, *path: Path) -> None:
        env = os.environ | {"PYTHONPATH": os.pathsep.join([*map(str, path), os.environ.get("PYTHONPATH", "")])}
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", _PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env
        )
        weakref.finalize(self, self._process.kill)

    def run(self, *words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        """Do as ``python WORDS`` would: a script or ``-c CODE``, and arguments."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
            command = tuple(map(str, words))
            pickle.dump((command, str(cwd or Path.cwd()), (out.name, err.name)), self._process.stdin)
            self._process.stdin.flush()
            code: Any = pickle.load(self._process.stdout)
            return subprocess.CompletedProcess(command, code, out.read(), err.read())
