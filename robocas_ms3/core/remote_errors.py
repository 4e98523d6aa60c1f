"""Send errors with their tracebacks from one process to another."""

from __future__ import annotations

import pickle
from contextlib import suppress
from dataclasses import dataclass
from traceback import format_exception
from typing import NoReturn

from robocas_ms3.core.signals import make_exit_error


@dataclass(frozen=True)
class RemoteError:
    """Picklable copy of an error and its traceback, to send to another process."""

    error: BaseException  # a RuntimeError with the same message if the error cannot be pickled
    where: str  # the process that raised the error, such as "a worker"
    traceback: str

    @classmethod
    def from_error(cls, error: BaseException, where: str) -> RemoteError:
        """Make a picklable copy of an error; an error that cannot be pickled becomes a RuntimeError.

        Args:
            error: the error. If it came from another process, the copy keeps the name of that process.
            where: name of this process, such as "a worker".
        """
        if isinstance(error, SystemExit):  # a SystemExit would end the receiving process without a message
            error = make_exit_error(error, where).with_traceback(error.__traceback__)
        cause = error.__cause__
        place = cause.args if isinstance(cause, RemoteTraceback) else (where, "".join(format_exception(error)))
        with suppress(Exception):  # pickling may raise any error
            if type(pickle.loads(pickle.dumps(error))) is type(error):
                return cls(error, *place)
        return cls(RuntimeError(f"{type(error).__name__}: {error}"), *place)

    def make_error(self) -> BaseException:
        """Return the original error, with a `RemoteTraceback` as its cause."""
        self.error.__cause__ = RemoteTraceback(self.where, self.traceback)
        return self.error

    def reraise(self) -> NoReturn:
        """Raise the original error, with a `RemoteTraceback` as its cause."""
        raise self.make_error()


class RemoteTraceback(Exception):  # noqa: N818  (the cause of an error, as in `concurrent.futures`)
    """Traceback of an error in another process, as text, because tracebacks cannot be pickled."""

    def __str__(self) -> str:
        where, text = self.args
        return f"in {where}:\n{text}"
