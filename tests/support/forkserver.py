"""Run commands without the seconds of imports: a process that has imported the package forks for each command.

This process is a fork of a process that has imported the libraries, which all servers share.
"""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import sys
import tempfile
import weakref
from functools import cache
from pathlib import Path
from typing import Any

_LIBRARIES = """
import os, pickle, signal, socket, sys
import torch, mani_skill.envs
link = socket.socket(fileno=int(sys.argv.pop()))
signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps its forks
while True:
    order, ends, *_ = socket.recv_fds(link, 2**20, 2)
    if not order:
        break
    if os.fork() == 0:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        link.close()
        for number, end in enumerate(ends):
            os.dup2(end, number)
            os.close(end)
        program, path, environment = pickle.loads(order)
        os.environ.clear()
        os.environ.update(environment)
        sys.path[1:1] = path
        exec(program)
    for end in ends:
        os.close(end)
"""

_PROGRAM = """
import os, pickle, runpy, sys, types
answers = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)
import robocas_ms3.cli.main, robocas_ms3.demos.generation, robocas_ms3.tasks.base
import robocas_ms3.evaluation.rollouts.session

def execute(words, folder, outputs):
    for stream in (1, 2):
        os.dup2(os.open(outputs[stream - 1], os.O_WRONLY | os.O_TRUNC), stream)
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
            execute(*order)
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


@cache
def _libraries() -> socket.socket:
    """Return the socket of the process that has imported the libraries; it ends with this process."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with there:
        command = [sys.executable, "-W", "ignore", "-c", _LIBRARIES, str(there.fileno())]
        subprocess.Popen(command, pass_fds=[there.fileno()], stdin=subprocess.DEVNULL)
    return here


class ForkServer:
    """Python with the package imported, ready for commands.

    Args:
        path: folders of packages, before all other folders.
    """

    def __init__(self, *path: Path) -> None:
        folders = [str(folder) for folder in path]
        env = os.environ | {"PYTHONPATH": os.pathsep.join([*folders, os.environ.get("PYTHONPATH", "")])}
        (orders, self._orders), (self._answers, answers) = _pipe(), _pipe()
        with orders, answers:
            order = pickle.dumps((_PROGRAM, folders, dict(env)))
            socket.send_fds(_libraries(), [order], [orders.fileno(), answers.fileno()])
        weakref.finalize(self, self._orders.close)  # ends the process

    def run(self, *words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        """Run ``python WORDS``: a script or ``-c CODE``, with arguments."""
        with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
            command = tuple(map(str, words))
            pickle.dump((command, str(cwd or Path.cwd()), (out.name, err.name)), self._orders)
            self._orders.flush()
            code: Any = pickle.load(self._answers)
            return subprocess.CompletedProcess(command, code, out.read(), err.read())


def _pipe() -> tuple[Any, Any]:
    """Return the two ends of a pipe, for reading and for writing."""
    ends = os.pipe()
    return os.fdopen(ends[0], "rb"), os.fdopen(ends[1], "wb")
