"""Errors that one process sends to another, with their tracebacks."""

from __future__ import annotations

import pickle
from contextlib import suppress
from dataclasses import dataclass
from traceback import format_exception
from typing import NoReturn

from robocas_ms3.core.signals import exit_error


@dataclass(frozen=True)
class RemoteError:
    """An error in a form that can be pickled."""

    error: BaseException  # another with its message where it can't be pickled
    where: str  # the process that raised it, such as "a branch"
    traceback: str  # there

    @classmethod
    def of(cls, error: BaseException, where: str) -> RemoteError:
        """Return an error in this form; one that can't be pickled becomes a RuntimeError.

        ``where`` names this process; an error from another process keeps the name of that one.
        """
        if isinstance(error, SystemExit):  # would end the receiving process without a message
            error = exit_error(error, where).with_traceback(error.__traceback__)
        cause = error.__cause__
        place = cause.args if isinstance(cause, RemoteTraceback) else (where, "".join(format_exception(error)))
        with suppress(Exception):  # any error of pickling it
            if type(pickle.loads(pickle.dumps(error))) is type(error):
                return cls(error, *place)
        return cls(RuntimeError(f"{type(error).__name__}: {error}"), *place)

    def with_traceback(self) -> BaseException:
        """Return the error with a `RemoteTraceback` as its cause."""
        self.error.__cause__ = RemoteTraceback(self.where, self.traceback)
        return self.error

    def reraise(self) -> NoReturn:
        raise self.with_traceback()


class RemoteTraceback(Exception):  # noqa: N818  (the cause of an error, as in `concurrent.futures`)
    """The text of a traceback in another process; tracebacks can't be pickled."""

    def __str__(self) -> str:
        where, text = self.args
        return f"in {where}:\n{text}"
