"""Branches of an episode, each in a forked process: what is tried there leaves no trace here.

A decision (`planning.decisions`) forks a child for each candidate. The child plays it, says how well it went, and
waits. The best one is told to go on: it *is* the episode from then on, while this process waits for its end. Where it
fails, this process, still at the decision, tells the next best. So processes stand in a row, one for each decision
made, and the last one writes the episode. No way is simulated twice, and the actions since the reset remain all there
is.

Children die with their parents, leave no zombies, and have a time limit. One that is gone is played once more: if it
was killed from outside, the episode stays what it would have been; if it crashes again, it is passed over, or, where it
had been told to go on, a failed attempt.
"""

from __future__ import annotations

import gc
import logging
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, NoReturn, Protocol, TypeVar

from robocas_ms3.demos.forking import die_with, piped_fork, streams_of_its_own
from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.decisions import ONE_BY_ONE, Decisions, Effort

T = TypeVar("T")

PLAY_LIMIT, GO_ON_LIMIT = 300.0, 3600.0  # s of wall-clock time for one candidate; for the rest of the episode
_log = logging.getLogger(__name__)


class Tally(Protocol):
    """What survives a branch: where time went and what failed. Whoever is running has the only valid one."""

    @property
    def exhausted(self) -> bool:
        """Whether no further attempt may be made."""
        ...

    def failed(self, error: PlanningFailed) -> None:
        """Note a failed attempt."""
        ...

    def adopt(self, other: Any) -> None:
        """Become what another process sent."""
        ...


class Undone(Exception):  # noqa: N818  (no error: the attempts from here have failed, and are noted already)
    """Every way from here was gone, in vain: the decision before has to be made otherwise."""


class BranchingDecisions(Decisions, Protocol):
    """Decisions that can be undone, around one attempt after the other."""

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt, which makes decisions; it begins with a reset.

        Returns:
            Whether it, or one that decided otherwise, ended well. What failed is in the tally.
        """
        ...


class _Done(Exception):  # noqa: N818
    """The episode has ended well, in a child."""


class _Crashed(Exception):  # noqa: N818
    """A child took too long, or is gone."""


class _Gone(_Crashed):
    """A child has ended without a word."""


@dataclass
class _Child:
    pid: int
    pipe: Connection
    candidate: Any
    answer: Any = None


@dataclass(frozen=True)
class _Failed:
    """Message of a child: its candidate can't be done, or what came after it failed."""

    error: PlanningFailed | None = None


@dataclass(frozen=True)
class _Raised:
    """Message of a child: an error that is no failure of its candidate, and where it came from."""

    error: BaseException
    traceback: str


class BranchTraceback(Exception):  # noqa: N818  (shown as the cause of an error, as `concurrent.futures` does)
    """Where in a child an error came from, as text: tracebacks can't be sent."""

    def __str__(self) -> str:
        return f"in a branch\n\n{self.args[0]}"


class ForkedBranches:
    """Makes decisions by forking; see the module.

    Args:
        tally: of the episode; children send theirs back.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._pipe: Connection | None = None  # to the parent, in a child
        self._children: list[_Child] = []

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt; see `BranchingDecisions`. A child's ends here."""
        ended_well = False
        try:
            attempt()
            ended_well = True
        except _Done:
            ended_well = True
        except Undone:
            pass
        except PlanningFailed as error:
            self._tally.failed(error)
        except BaseException as error:
            if self._pipe is not None:
                self._say_and_leave(_raised(error))
            raise
        if self._pipe is not None:
            self._say_and_leave("done" if ended_well else _Failed())
        return ended_well

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        """Choose; see `Decisions`. Returns in the child that goes on."""
        failure, gone_on, left = PlanningFailed("decision", "no_candidate"), 0, iter(candidates)
        try:
            while gone_on < effort.tries and not self._tally.exhausted:
                for candidate in left:
                    child = self._look(play, candidate)
                    if child is None:
                        return candidate
                    if isinstance(child.answer, _Failed):
                        failure = child.answer.error or failure
                        continue
                    if len(self._children) == effort.ahead or child.answer >= effort.enough:
                        break
                if not self._children:
                    break
                for child in sorted(self._children, key=lambda child: -child.answer):
                    if not self._go_on_as(child):
                        again = self._look(play, child.candidate)
                        if again is None:
                            return child.candidate
                        if isinstance(again.answer, _Failed) or not self._go_on_as(again):
                            self._tally.failed(PlanningFailed("branch", "crashed"))
                    gone_on += 1
                    if gone_on == effort.tries or self._tally.exhausted:
                        break
                self._end_all()
        finally:
            self._end_all()
        if gone_on:
            raise Undone
        raise failure

    # ------------------------------------------------------------------ this process

    def _look(self, play: Callable[[T], float], candidate: T) -> _Child | None:
        """A child that has played a candidate, with what it said; None in the child itself, where it shall go on.

        The child has ended where it, or its second try, failed.
        """
        for last in (False, True):
            child = self._fork(candidate)
            if child is None:
                self._play(play, candidate)
                return None
            try:
                child.answer = self._hear(child, PLAY_LIMIT)
            except _Crashed as error:
                child.answer = _Failed(PlanningFailed("branch", str(error)))
                if isinstance(error, _Gone) and not last:
                    self._end(child)
                    continue
            break
        if isinstance(child.answer, _Failed):
            self._end(child)
        return child

    def _fork(self, candidate: Any) -> _Child | None:
        """A new child for a candidate; None in the child itself."""
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:  # as in a service
                stream.flush()
        parent = os.getpid()
        # an interrupt in between would find a child without a parent, or a child that takes itself for the root
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            here, there, pid = piped_fork()
            if pid:
                child = _Child(pid, here, candidate)
                self._children.append(child)
                there.close()
                return child
            not_ours = [here, *(other.pipe for other in self._children), *([self._pipe] if self._pipe else [])]
            self._pipe, self._children = there, []
            die_with(parent)
            gc.freeze()  # a collection that walks all objects would copy all of the parent's memory
            streams_of_its_own()
            for pipe in not_ours:
                pipe.close()
            return None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _go_on_as(self, child: _Child) -> bool:
        """Let a child be the episode; comes back where that fails, or, with False, where the child is gone.

        Raises:
            _Done: it ended well.
        """
        try:
            _tell(child, self._tally)
            answer = self._hear(child, GO_ON_LIMIT)
        except _Gone:
            return False
        except _Crashed as error:
            self._tally.failed(PlanningFailed("branch", str(error)))
            return True
        finally:
            self._end(child)
        if answer == "done":
            raise _Done
        return True

    def _hear(self, child: _Child, limit: float) -> Any:
        """What a child says next; its tally is ours then.

        Raises:
            _Crashed: it is gone (`_Gone`), or says nothing.
            BaseException: what it ended with, caused by a `BranchTraceback`.
        """
        try:
            if not child.pipe.poll(limit):
                raise _Crashed("timed_out")
            answer, tally = child.pipe.recv()
        except (EOFError, OSError) as error:  # it ended before it said anything, or in the middle of it
            raise _Gone("crashed") from error
        if isinstance(answer, _Raised):
            raise answer.error from BranchTraceback(answer.traceback)
        self._tally.adopt(tally)
        return answer

    def _end(self, child: _Child) -> None:
        self._children.remove(child)
        child.pipe.close()
        os.kill(child.pid, signal.SIGKILL)  # it is still ours, if only as a zombie
        os.waitpid(child.pid, 0)

    def _end_all(self) -> None:
        for child in list(self._children):
            self._end(child)

    # ------------------------------------------------------------------ a child

    def _play(self, play: Callable[[T], float], candidate: T) -> None:
        """Play a candidate, say how it went, and wait to be told to go on."""
        try:
            answer: Any = float(play(candidate))
        except PlanningFailed as error:
            self._say_and_leave(_Failed(error))
        except BaseException as error:
            self._say_and_leave(_raised(error))
        assert self._pipe is not None
        try:
            self._pipe.send((answer, self._tally))
            self._tally.adopt(self._pipe.recv())
        except (EOFError, ConnectionError):
            os._exit(0)

    def _say_and_leave(self, answer: Any) -> NoReturn:
        assert self._pipe is not None
        try:
            self._end_all()
            self._pipe.send((answer, self._tally))
        except Exception:  # noqa: BLE001  (nobody listens)
            if isinstance(answer, _Raised):
                _log.error("a branch failed\n%s", answer.traceback)
        finally:  # not even an interrupt leads back into the code that the parent runs too
            os._exit(0)


def _tell(child: _Child, tally: Tally) -> None:
    """Let a child go on with a tally.

    Raises:
        _Gone: there is no child any more.
    """
    try:
        child.pipe.send(tally)
    except OSError as error:
        raise _Gone("crashed") from error


def _raised(error: BaseException) -> _Raised:
    """An error as it can be sent; its traceback is that of the process where it was raised first."""
    cause = error.__cause__
    text = cause.args[0] if isinstance(cause, BranchTraceback) else "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001  (its class decides what that raises)
        return _Raised(RuntimeError(f"{type(error).__name__}: {error}"), text)
    return _Raised(error, text)
