"""What a worker process of `workers.WorkerPool` runs."""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from tqdm import tqdm

from robocas_ms3.core.exits import die_with_parent, end_process, exit_error
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.words import escape_log_lines, escape_tracebacks


def main(descriptor: int, parent: int) -> None:
    """Run tasks until the pool closes the connection.

    Args:
        descriptor: file descriptor of the connection.
        parent: process id of the pool's process.
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # a terminal or a batch system sends them to all processes
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    die_with_parent(parent)
    os.set_inheritable(descriptor, False)
    escape_log_lines()
    escape_tracebacks()
    tqdm.set_lock(threading.RLock())  # its own is a semaphore of the system, which a killed process leaves behind
    with suppress(EOFError, OSError):
        _Server(Connection(descriptor)).serve()
    end_process(0)


class _Server:
    """Answers each message of the pool with a result or a `RemoteError`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._make_worker: Any = None
        self._worker: Any = None

    def serve(self) -> None:
        """Make the worker, then run tasks.

        Raises:
            OSError: the pool is gone; or EOFError.
        """
        self._connection.send(None)
        self._answer(self._start)
        while True:
            self._answer(self._run)

    def _start(self, make_worker: bytes) -> None:
        self._make_worker = pickle.loads(make_worker)
        self._worker = self._make_worker()

    def _run(self, task: Any) -> Any:
        if self._worker is None:
            self._worker = self._make_worker()
        try:
            return self._worker.run(task)
        except BaseException:
            worker, self._worker = self._worker, None
            worker.close()
            raise

    def _answer(self, function: Callable[[Any], Any]) -> None:
        message = self._connection.recv_bytes()
        try:
            answer = function(pickle.loads(message))
        except KeyboardInterrupt as error:  # of the code: the process ignores Ctrl-C
            answer = RemoteError.of(exit_error(error, "a worker"), "a worker")
        except BaseException as error:  # noqa: BLE001  (it is raised again in the pool's process)
            answer = RemoteError.of(error, "a worker")
        try:
            self._connection.send(answer)
        except OSError:
            raise
        except Exception as error:  # the result can't be pickled
            self._connection.send(RemoteError.of(error, "a worker"))
