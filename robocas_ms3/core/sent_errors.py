"""Errors sent from one process to another, with where they were raised."""

from __future__ import annotations

import pickle
from contextlib import suppress
from dataclasses import dataclass
from traceback import format_exception
from typing import NoReturn

from robocas_ms3.core.exits import exit_error


@dataclass(frozen=True)
class SentError:
    """An error as it can be sent to another process, through a pipe.

    Attributes:
        error: it, or what says the same in its stead.
        where: it was raised first, such as "a branch".
        traceback: of there.
    """

    error: BaseException
    where: str
    traceback: str

    @classmethod
    def of(
        cls,
        error: BaseException,
        where: str,
        *,
        sendable: type[BaseException] = BaseException,
        otherwise: type[Exception] = RuntimeError,
    ) -> SentError:
        """Make an error ready to be sent.

        Args:
            error: it.
            where: this process is what; of an error that was sent here, where it came from remains.
            sendable: what is sent as it is, if it pickles.
            otherwise: the type of what takes an error's place if not.
        """
        if isinstance(error, SystemExit):  # which would end the process that it is sent to, without a word
            error = exit_error(error, where).with_traceback(error.__traceback__)
        cause = error.__cause__
        place = cause.args if isinstance(cause, SentTraceback) else (where, "".join(format_exception(error)))
        with suppress(Exception):  # whatever its class does
            if isinstance(error, sendable) and type(pickle.loads(pickle.dumps(error))) is type(error):
                return cls(error, *place)
        return cls(otherwise(f"{type(error).__name__}: {error}"), *place)

    def reraise(self) -> NoReturn:
        """Raise the error here."""
        raise self.with_traceback()

    def with_traceback(self) -> BaseException:
        """The error, caused by where it came from."""
        self.error.__cause__ = SentTraceback(self.where, self.traceback)
        return self.error


class SentTraceback(Exception):  # noqa: N818  (shown as the cause of an error, as `concurrent.futures` does)
    """Where in another process an error came from, as text: tracebacks can't be sent."""

    def __str__(self) -> str:
        where, text = self.args
        return f"in {where}:\n{text}"
