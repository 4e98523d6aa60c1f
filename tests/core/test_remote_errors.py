"""Errors that one process sends to another."""

from __future__ import annotations

import pickle

import pytest

from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.remote_errors import RemoteError, RemoteTraceback


class TwoWords(Exception):
    """Can be pickled, but not unpickled."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(f"{one} {two}")


class Chameleon(Exception):
    """Is unpickled as another type."""

    def __reduce__(self) -> tuple[type, tuple[str]]:
        return str, ("nothing",)


def raised(error: BaseException) -> BaseException:
    try:
        raise error
    except BaseException as caught:  # noqa: BLE001
        return caught


def received(sent: RemoteError) -> BaseException:
    """Return the error that the receiving process raises."""
    with pytest.raises(BaseException) as caught:  # noqa: PT011
        pickle.loads(pickle.dumps(sent)).reraise()
    return caught.value


def test_an_error_keeps_its_type_arguments_and_traceback():
    error = received(RemoteError.from_error(raised(KeyError("seven")), "env 7"))
    assert (type(error), error.args) == (KeyError, ("seven",))
    assert isinstance(error.__cause__, RemoteTraceback)
    assert str(error.__cause__).startswith("in env 7:\nTraceback")
    assert "in raised\n" in str(error.__cause__)


def test_an_error_sent_twice_keeps_the_first_traceback():
    first = received(RemoteError.from_error(raised(KeyError("seven")), "env 7"))
    second = received(RemoteError.from_error(first, "a branch"))
    assert str(second.__cause__) == str(first.__cause__)


@pytest.mark.parametrize("error", [TwoWords("very", "odd"), Chameleon("very odd")])
def test_an_error_that_cannot_be_pickled_is_replaced(error):
    found = received(RemoteError.from_error(error, "a branch"))
    assert (type(found), str(found)) == (RuntimeError, f"{type(error).__name__}: very odd")


def test_an_exit_does_not_end_the_receiving_process():
    assert type(received(RemoteError.from_error(KeyboardInterrupt(), "a branch"))) is KeyboardInterrupt
    exited = received(RemoteError.from_error(SystemExit(3), "env 0"))
    assert (type(exited), exited.where) == (ExtensionError, "env 0")
