"""A worker process as the process that started it sees it: starting, talking, dying, leaving."""

from __future__ import annotations

import math
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from numpy.typing import NDArray

from robocas_ms3.core.errors import VectorEnvError, WorkerDied
from robocas_ms3.core.exits import deferred_interrupts
from robocas_ms3.core.worker_process import exceeds_memory
from robocas_ms3.core.workers import NO_LIMITS

STEP, LEAVE = b"s", b"q"  # messages; all others are pickled
NUMBER = 8  # bytes before each message, its number, which the answer repeats
_GRACE, _GRACE_AT_WORK = 10.0, 1.0  # s to leave in
_LOOK = 1.0  # s between two looks at what it takes
_POLL = 0.2  # s until a signal is handled
# Neither fork nor multiprocessing's spawn: a process with a renderer or CUDA can't be forked, and spawn runs the user's
# program again, which a program without `if __name__ == "__main__"`, a notebook and a program from a pipe don't stand.
_PROGRAM = """\
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
sys.path[:] = {path!r}
from robocas_ms3.tasks.vector.worker import main
main({connection}, {memory}, {parent})
"""


class WorkerHandle:
    """A process that has some of the environments.

    Args:
        envs: their numbers.
        memory: file descriptor of the shared memory.

    Raises:
        VectorEnvError: the system allows no more processes or open files.

    Attributes:
        at_work: (num_envs,) bool, shared, which envs are resetting or stepping; None: not known yet.
        limits: of what it is asked for.
    """

    def __init__(self, envs: range, memory: int) -> None:
        self.envs = envs
        self._asked = self._answered = 0  # messages have numbers: an interrupted call leaves an answer behind
        self.at_work: NDArray[Any] | None = None
        self.limits, self._looked = NO_LIMITS, time.monotonic()
        here, there = socket.socketpair()
        with there:
            program = _PROGRAM.format(path=sys.path, connection=there.fileno(), memory=memory, parent=os.getpid())
            try:
                with deferred_interrupts():
                    self.process = subprocess.Popen(
                        [sys.executable, "-c", program],
                        pass_fds=(there.fileno(), memory),
                        stdin=subprocess.DEVNULL,
                        start_new_session=True,  # a terminal sends its Ctrl-C to this process alone
                        # one thread each, also of the software renderer: those of several get in each other's way
                        env={"OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1", **os.environ},
                    )
            except OSError as error:
                raise VectorEnvError(
                    "can't start a process",
                    where=name_envs(envs),
                    found=error.strerror,
                    fix="Use fewer workers, or raise the limits (ulimit -u, -n).",
                ) from error
        self.connection = Connection(here.detach())

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        return self._answered < self._asked

    def send(self, message: bytes) -> None:
        """Ask for something.

        Raises:
            WorkerDied: the process is no more.
        """
        self._asked += 1
        try:
            self.connection.send_bytes(self._asked.to_bytes(NUMBER, "little") + message)
        except OSError as error:
            raise self._died() from error

    def receive(self) -> Any:
        """The answer to what was asked last; None where there is nothing to say, a `RemoteError` if an env failed.

        Raises:
            WorkerDied: the process is no more.
        """
        while self.busy:
            try:
                self._wait()
                answer = self.connection.recv_bytes()
            except (EOFError, OSError) as error:
                raise self._died() from error
            self._answered = int.from_bytes(answer[:NUMBER], "little")
        return pickle.loads(answer[NUMBER:]) if len(answer) > NUMBER else None

    def _wait(self) -> None:
        """Wait for an answer.

        Raises:
            WorkerDied: the process took more than it may, and was ended.
        """
        begun = time.monotonic()
        while True:
            now = time.monotonic()
            why = "too slow" if now - begun > self.limits.seconds else ""
            if now - self._looked > _LOOK and self.limits.memory_gb < math.inf:
                self._looked = now
                why = "too much memory" if exceeds_memory(self.process.pid, self.limits.memory_gb, forks=False) else why
            if why:
                self.process.kill()
                raise self._died(why)
            with deferred_interrupts():
                answered = self.connection.poll(_POLL)
            if answered:
                return

    def _died(self, why: str = "") -> WorkerDied:
        try:
            code = self.process.wait(_GRACE_AT_WORK)
        except subprocess.TimeoutExpired:
            code = None  # it closed its end and lives on
        how = f"exit code {code}"
        if code is not None and code < 0:
            how = f"{signal.Signals(-code).name}{', is memory short?' if code == -signal.SIGKILL else ''}"
        at_work = [] if self.at_work is None else [env for env in self.envs if self.at_work[env]]
        envs = at_work or list(self.envs)
        what, fix = "its process died", "Make the environments again."
        died = WorkerDied(what, where=name_envs(envs), found=why or how, fix=fix)
        died.envs = tuple(envs)
        return died


def name_envs(envs: Sequence[int]) -> str:
    """Words for some environments."""
    if len(envs) == 1:
        return f"env {envs[0]}"
    in_a_row = len(envs) > 2 and envs[-1] - envs[0] == len(envs) - 1
    return f"envs {envs[0]} to {envs[-1]}" if in_a_row else f"envs {', '.join(map(str, envs))}"


def close_all(workers: list[WorkerHandle], memory: int, owner: int) -> None:
    """Let workers close their environments and leave, and end those that don't.

    Args:
        workers: all of them.
        memory: file descriptor to close.
        owner: process that started them; in another, as a fork of it, nothing happens.
    """
    if os.getpid() != owner:
        return
    busy = [worker for worker in workers if worker.busy]
    for worker in workers:
        with suppress(WorkerDied):
            worker.send(LEAVE)
        worker.connection.close()
    begun = time.monotonic()
    for worker in workers:
        until = begun + (_GRACE_AT_WORK if worker in busy else _GRACE)
        try:
            worker.process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()
    os.close(memory)
