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
        _serve(Connection(descriptor))
    end_process(0)


def _serve(connection: Connection) -> None:
    """Make the worker, then run tasks; answer each message with a result or a `RemoteError`."""
    make_worker: Any = None
    worker: Any = None

    def start(pickled: bytes) -> None:
        nonlocal make_worker, worker
        make_worker = pickle.loads(pickled)
        worker = make_worker()

    def run(task: Any) -> Any:
        nonlocal worker
        if worker is None:
            worker = make_worker()
        try:
            return worker.run(task)
        except BaseException:
            failed, worker = worker, None
            failed.close()
            raise

    connection.send(None)
    _answer(connection, start)
    while True:
        _answer(connection, run)


def _answer(connection: Connection, function: Callable[[Any], Any]) -> None:
    message = connection.recv_bytes()
    try:
        answer = function(pickle.loads(message))
    except KeyboardInterrupt as error:  # of the code: the process ignores Ctrl-C
        answer = RemoteError.of(exit_error(error, "a worker"), "a worker")
    except BaseException as error:  # noqa: BLE001  (it is raised again in the pool's process)
        answer = RemoteError.of(error, "a worker")
    try:
        connection.send(answer)
    except OSError:
        raise
    except Exception as error:  # the result can't be pickled
        connection.send(RemoteError.of(error, "a worker"))
