"""Errors as they are sent through a pipe from one process to another."""

from __future__ import annotations

import pickle

import pytest

from robocas_ms3.core.errors import ExtensionError, VectorEnvError
from robocas_ms3.core.sent_errors import SentError, SentTraceback


class TwoWords(Exception):
    """Pickles, but can't be made again."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(f"{one} {two}")


class Chameleon(Exception):
    """Is something else once it has been sent."""

    def __reduce__(self) -> tuple[type, tuple[str]]:
        return str, ("nothing",)


def raised(error: BaseException) -> BaseException:
    try:
        raise error
    except BaseException as caught:  # noqa: BLE001
        return caught


def received(sent: SentError) -> BaseException:
    """What the other process raises."""
    with pytest.raises(BaseException) as caught:  # noqa: PT011
        pickle.loads(pickle.dumps(sent)).reraise()
    return caught.value


def test_it_arrives_with_the_place_where_it_was_raised():
    error = received(SentError.of(raised(KeyError("seven")), "env 7"))
    assert (type(error), error.args) == (KeyError, ("seven",))
    assert isinstance(error.__cause__, SentTraceback)
    assert str(error.__cause__).startswith("in env 7:\nTraceback")
    assert "in raised\n" in str(error.__cause__)


def test_what_goes_on_to_a_third_process_keeps_its_first_place():
    first = received(SentError.of(raised(KeyError("seven")), "env 7"))
    second = received(SentError.of(first, "a branch"))
    assert str(second.__cause__) == str(first.__cause__)


@pytest.mark.parametrize("error", [TwoWords("very", "odd"), Chameleon("very odd")])
def test_what_does_not_come_through_is_told_of(error):
    assert str(received(SentError.of(error, "a branch"))) == f"{type(error).__name__}: very odd"
    assert type(received(SentError.of(error, "env 0", otherwise=VectorEnvError))) is VectorEnvError


def test_what_must_not_end_the_other_process_is_told_of():
    assert type(received(SentError.of(KeyboardInterrupt(), "a branch"))) is KeyboardInterrupt
    sent = SentError.of(KeyboardInterrupt(), "env 0", sendable=Exception, otherwise=VectorEnvError)
    assert type(received(sent)) is VectorEnvError
    exited = received(SentError.of(SystemExit(3), "env 0"))
    assert (type(exited), exited.where) == (ExtensionError, "env 0")
