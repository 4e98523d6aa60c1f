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

import logging
import os
import signal
from collections.abc import Callable, Iterable
from multiprocessing.connection import Connection
from typing import Any, NoReturn, TypeVar

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.demos.backtracking import DeadEnd, Tally, turns
from robocas_ms3.demos.forking import Child, ChildCrash, ChildGone, fork, set_up_child
from robocas_ms3.planning.decisions import ONE_BY_ONE, Effort

T = TypeVar("T")

PLAY_LIMIT, GO_ON_LIMIT = 300.0, 3600.0  # s of wall-clock time for one candidate; for the rest of the episode
_log = logging.getLogger(__name__)


class _Success(Exception):  # noqa: N818
    """The episode has ended well, in a child."""


class ForkedBranches:
    """Makes decisions by forking; see the module.

    Args:
        tally: of the episode; children send theirs back.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._pipe: Connection | None = None  # to the parent, in a child
        self._children: list[Child] = []

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt, which makes decisions and begins with a reset. A child's ends here.

        Returns:
            Whether it, or one that decided otherwise, ended well. What failed is in the tally.
        """
        ended_well = True
        try:
            attempt()
        except _Success:
            pass
        except DeadEnd:
            ended_well = False
        except PlanningFailed as error:
            self._tally.failed(error)
            ended_well = False
        except BaseException as error:
            if self._pipe is not None:
                self._say_and_leave(RemoteError.of(error, "a branch"))
            raise
        if self._pipe is not None:
            self._say_and_leave(ended_well)
        return ended_well

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        """Choose; see `Decisions`. Returns in the child that goes on."""
        order = turns(enumerate(candidates), effort, self._tally)
        played: dict[int, Child] = {}
        outcome: float | PlanningFailed | None = None
        try:
            while True:
                (number, candidate), go_on = order.send(outcome)
                outcome = None
                if not go_on:
                    child, outcome = self._look(play, candidate)
                    if child is None:
                        return candidate
                    played[number] = child
                elif not self._go_on_as(played[number]):
                    again, failure = self._look(play, candidate)
                    if again is None:
                        return candidate
                    if isinstance(failure, PlanningFailed) or not self._go_on_as(again):
                        self._tally.failed(PlanningFailed("branch", "crashed"))
        finally:
            self._end_all()

    # ------------------------------------------------------------------ this process

    def _look(self, play: Callable[[T], float], candidate: T) -> tuple[Child | None, float | PlanningFailed]:
        """A child that has played a candidate, with what it said; no child in itself, where it shall go on."""
        for last in (False, True):
            child = self._fork()
            if child is None:
                self._play(play, candidate)
                return None, 0.0
            try:
                outcome = self._hear(child, PLAY_LIMIT)
            except ChildCrash as error:
                outcome = PlanningFailed("branch", str(error))
                if isinstance(error, ChildGone) and not last:
                    self._end(child)
                    continue
            break
        if isinstance(outcome, PlanningFailed):
            self._end(child)
        return child, outcome

    def _fork(self) -> Child | None:
        """A new child; None in itself."""
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

    def _go_on_as(self, child: Child) -> bool:
        """Let a child be the episode; comes back where that fails, or, with False, where the child is gone."""
        try:
            child.tell(self._tally)
            ended_well = self._hear(child, GO_ON_LIMIT)
        except ChildGone:
            return False
        except ChildCrash as error:
            self._tally.failed(PlanningFailed("branch", str(error)))
            return True
        finally:
            self._end(child)
        if ended_well:
            raise _Success
        return True

    def _hear(self, child: Child, limit: float) -> Any:
        """What a child says next; its tally is ours then."""
        answer, tally = child.hear(limit)
        if isinstance(answer, RemoteError):
            answer.reraise()
        self._tally.adopt(tally)
        return answer

    def _end(self, child: Child) -> None:
        self._children.remove(child)
        child.end()

    def _end_all(self) -> None:
        for child in list(self._children):
            self._end(child)

    # ------------------------------------------------------------------ a child

    def _play(self, play: Callable[[T], float], candidate: T) -> None:
        """Play a candidate, say how it went, and wait to be told to go on."""
        try:
            score = float(play(candidate))
        except PlanningFailed as error:
            self._say_and_leave(error)
        except BaseException as error:
            self._say_and_leave(RemoteError.of(error, "a branch"))
        assert self._pipe is not None
        try:
            self._pipe.send((score, self._tally))
            self._tally.adopt(self._pipe.recv())
        except (EOFError, ConnectionError):
            os._exit(0)

    def _say_and_leave(self, answer: bool | PlanningFailed | RemoteError) -> NoReturn:
        assert self._pipe is not None
        try:
            self._end_all()
            self._pipe.send((answer, self._tally))
        except Exception:  # noqa: BLE001  (nobody listens)
            if isinstance(answer, RemoteError):
                _log.error("a branch failed\n%s", answer.traceback)
        finally:  # not even an interrupt leads back into the code that the parent runs too
            os._exit(0)
