"""Branches of an episode, each in a forked process: what is tried there leaves no trace here.

A decision (`planning.decisions`) forks a child per candidate. The child plays it, sends its score, and waits. The best
child is told to continue: it *is* the episode from then on, while this process waits for its end. If it fails, this
process, still at the decision, tells the next best. So processes stand in a row, one per decision, and the last one
writes the episode. No candidate is simulated twice.

Children die with their parents, leave no zombies, and have a time limit. A child that is gone is played once more: if
it was killed from outside, the episode stays the same; if it crashes again, it is passed over, or counts as a failed
attempt where it had been told to continue.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NoReturn, TypeVar, cast

import torch

from robocas_ms3.core.errors import PlanningError, RobocasError
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.signals import die_with_parent
from robocas_ms3.demos.backtracking import DeadEnd, turns
from robocas_ms3.demos.failures import EpisodeResult
from robocas_ms3.planning.decisions import ONE_BY_ONE, Effort

T = TypeVar("T")

PLAY_LIMIT, CONTINUE_LIMIT = 300.0, 3600.0  # s of wall-clock time for one candidate; for the rest of the episode
_log = logging.getLogger(__name__)


class ChildCrash(Exception):  # noqa: N818
    """A child took too long, or is gone."""


class ChildGone(ChildCrash):
    """A child has ended without a word."""


@dataclass(frozen=True)
class Child:
    """A forked process."""

    pid: int
    pipe: Connection

    def send(self, message: Any) -> None:
        try:
            self.pipe.send(message)
        except OSError as error:
            raise ChildGone("crashed") from error

    def receive(self, limit: float) -> Any:
        """Return the child's next message; raises ``ChildCrash`` where there is none within ``limit`` seconds."""
        try:
            if not self.pipe.poll(limit):
                raise ChildCrash("timed_out")
            return self.pipe.recv()
        except (EOFError, OSError) as error:  # it ended before it said anything, or in the middle of it
            raise ChildGone("crashed") from error

    def end(self) -> None:
        self.pipe.close()
        os.kill(self.pid, signal.SIGKILL)  # it is still ours, if only as a zombie
        os.waitpid(self.pid, 0)


def fork() -> Child | Connection:
    """Fork this process; return the child, or in the child the pipe to this process."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as in a service
            stream.flush()
    try:
        here, there = cast("tuple[Connection, Connection]", Pipe())
        pid = os.fork()
    except OSError as error:
        raise RobocasError(
            "can't start another process",
            found=error.strerror,
            fix="Use fewer --jobs, raise the limits (ulimit -u, -n), or --no-fork, which is slower.",
        ) from error
    (there if pid else here).close()
    return Child(pid, here) if pid else there


def set_up_child(parent: int) -> None:
    """Set up a child before anything else; the system kills it when the process ``parent`` ends."""
    die_with_parent(parent)
    gc.freeze()  # a collection that walks all objects would copy all of the parent's memory
    torch.set_num_threads(1)  # the parent's threads are not here, and a parallel loop would wait for them forever
    # Threads that are not here may hold the locks of the parent's streams. A line is written as soon as it ends, since
    # a child ends without ado. Where there is no stream, as in a service, none is opened.
    sys.stdout, sys.stderr = (
        stream and os.fdopen(os.dup(fd), "w", buffering=1) for fd, stream in ((1, sys.stdout), (2, sys.stderr))
    )


def why_not_fork(*, renders: bool) -> str:
    """Return why this process, with or without an open renderer, can't be forked safely; empty where it can."""
    if sys.platform != "linux":
        return "this is not Linux"
    if renders:
        return "a renderer is open"
    if torch.cuda.is_initialized():
        return "CUDA is in use"
    return ""


@cache
def say_once(reason: str) -> None:
    _log.warning("can't fork (%s): what fails is undone by simulating everything again", reason)


class _Success(Exception):  # noqa: N818
    pass


class ForkedBranches:
    """Makes decisions by forking; children send back the result of the episode (``result``)."""

    def __init__(self, result: EpisodeResult) -> None:
        self._result = result
        self._pipe: Connection | None = None  # to the parent, in a child
        self._children: list[Child] = []

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt, which begins with a reset; return whether it, or one that decided otherwise, succeeded."""
        succeeded = True
        try:
            attempt()
        except _Success:
            pass
        except DeadEnd:
            succeeded = False
        except PlanningError as error:
            self._result.failed(error)
            succeeded = False
        except BaseException as error:
            if self._pipe is not None:
                self._send_and_exit(RemoteError.of(error, "a branch"))
            raise
        if self._pipe is not None:
            self._send_and_exit(succeeded)
        return succeeded

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        """Choose; see `Decisions`. Returns in the child that continues the episode."""
        order = turns(enumerate(candidates), effort, self._result)
        played: dict[int, Child] = {}
        outcome: float | PlanningError | None = None
        try:
            while True:
                (number, candidate), continues = order.send(outcome)
                outcome = None
                if not continues:
                    child, outcome = self._try(play, candidate)
                    if child is None:
                        return candidate
                    played[number] = child
                elif not self._continue_as(played[number]):
                    again, failure = self._try(play, candidate)
                    if again is None:
                        return candidate
                    if isinstance(failure, PlanningError) or not self._continue_as(again):
                        self._result.failed(PlanningError("branch", "crashed"))
        finally:
            self._end_children()

    def _try(self, play: Callable[[T], float], candidate: T) -> tuple[Child | None, float | PlanningError]:
        """Return a child that has played a candidate, and its answer; in the child, no child once it shall continue."""
        for last in (False, True):
            child = self._fork()
            if child is None:
                self._play(play, candidate)
                return None, 0.0
            try:
                outcome = self._receive(child, PLAY_LIMIT)
            except ChildCrash as error:
                outcome = PlanningError("branch", str(error))
                if isinstance(error, ChildGone) and not last:
                    self._end(child)
                    continue
            break
        if isinstance(outcome, PlanningError):
            self._end(child)
        return child, outcome

    def _fork(self) -> Child | None:
        """Return a new child; None in the child."""
        parent = os.getpid()
        # an interrupt in between would find a child without a parent, or a child that takes itself for the root
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            forked = fork()
            if isinstance(forked, Child):
                self._children.append(forked)
                return forked
            not_ours = [*(other.pipe for other in self._children), *([self._pipe] if self._pipe else [])]
            self._pipe, self._children = forked, []
            set_up_child(parent)
            for pipe in not_ours:
                pipe.close()
            return None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _continue_as(self, child: Child) -> bool:
        """Let a child continue the episode; return whether it failed (True), or is gone (False)."""
        try:
            child.send(self._result)
            succeeded = self._receive(child, CONTINUE_LIMIT)
        except ChildGone:
            return False
        except ChildCrash as error:
            self._result.failed(PlanningError("branch", str(error)))
            return True
        finally:
            self._end(child)
        if succeeded:
            raise _Success
        return True

    def _receive(self, child: Child, limit: float) -> Any:
        answer, result = child.receive(limit)
        if isinstance(answer, RemoteError):
            answer.reraise()
        self._result.adopt(result)
        return answer

    def _end(self, child: Child) -> None:
        self._children.remove(child)
        child.end()

    def _end_children(self) -> None:
        for child in list(self._children):
            self._end(child)

    def _play(self, play: Callable[[T], float], candidate: T) -> None:
        try:
            score = float(play(candidate))
        except PlanningError as error:
            self._send_and_exit(error)
        except BaseException as error:
            self._send_and_exit(RemoteError.of(error, "a branch"))
        assert self._pipe is not None
        try:
            self._pipe.send((score, self._result))
            self._result.adopt(self._pipe.recv())
        except (EOFError, ConnectionError):
            os._exit(0)

    def _send_and_exit(self, answer: bool | PlanningError | RemoteError) -> NoReturn:
        assert self._pipe is not None
        try:
            self._end_children()
            self._pipe.send((answer, self._result))
        except Exception:  # noqa: BLE001  (nobody listens)
            if isinstance(answer, RemoteError):
                _log.error("a branch failed\n%s", answer.traceback)
        finally:  # not even an interrupt leads back into the code that the parent runs too
            os._exit(0)
