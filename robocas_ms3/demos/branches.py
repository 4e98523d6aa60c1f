"""Backtracking with forked processes: each candidate runs in a separate process.

A decision (`planning.decisions`) forks a child process per candidate. The child runs the candidate, sends its score
and waits. The child with the best score then continues the episode, while the parent waits for the result. If the
episode fails there, the parent, which is still at the decision, lets the next best child continue. The processes form a
chain with one process per decision, and the last one writes the episode. No candidate is simulated twice.

A child process is killed when its parent ends or a time limit is exceeded. After a crash, the candidate is run once
more, so a kill from outside does not change the episode. After a second crash the candidate is skipped, or counts as a
failed attempt if the episode had continued from it.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterable
from multiprocessing.connection import Connection
from typing import Any, NoReturn, TypeVar

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.demos.backtracking import CandidatesExhaustedError, order_candidates
from robocas_ms3.demos.failures import EpisodeResult
from robocas_ms3.demos.forked_processes import (
    CANDIDATE_TIMEOUT,
    ForkedProcess,
    ForkedProcessCrashError,
    ForkedProcessError,
    fork,
    set_up_forked_process,
)
from robocas_ms3.planning.decisions import FIRST_FEASIBLE, SearchLimits

T = TypeVar("T")

EPISODE_TIMEOUT = 3600.0  # s of wall-clock time for the rest of the episode after a candidate
_log = logging.getLogger(__name__)


class _EpisodeFinished(Exception):  # noqa: N818
    """Signal that a child process finished the episode."""


class ForkedDecisions:
    """Decisions that undo motions by forking: each candidate runs in a child process.

    Args:
        result: result of the episode, which the child processes send back.
    """

    def __init__(self, result: EpisodeResult) -> None:
        self._result = result
        self._pipe: Connection | None = None  # to the parent, in a child
        self._children: list[ForkedProcess] = []

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt from its reset with backtracking; return whether it succeeded.

        ``attempt`` resets the environment, runs the policy and writes the episode.
        """
        succeeded = True
        try:
            attempt()
        except _EpisodeFinished:
            pass
        except CandidatesExhaustedError:
            succeeded = False
        except PlanningError as error:
            self._result.add_failure(error)
            succeeded = False
        except BaseException as error:
            if self._pipe is not None:
                self._send_and_exit(RemoteError.from_error(error, "a branch"))
            raise
        if self._pipe is not None:
            self._send_and_exit(succeeded)
        return succeeded

    def choose(
        self, candidates: Iterable[T], run_candidate: Callable[[T], float], limits: SearchLimits = FIRST_FEASIBLE
    ) -> T:
        """Choose a candidate as described in `Decisions.choose`.

        The method returns in the child process that continues the episode. In the parent process it raises an internal
        exception when the episode has succeeded, and CandidatesExhaustedError when it has failed.
        """
        order = order_candidates(enumerate(candidates), limits, self._result)
        children: dict[int, ForkedProcess] = {}
        outcome: float | PlanningError | None = None
        try:
            while True:
                (number, candidate), continues = order.send(outcome)
                outcome = None
                if not continues:
                    child, outcome = self._run_in_child(run_candidate, candidate)
                    if child is None:
                        return candidate
                    children[number] = child
                elif not self._continue_as(children[number]):
                    again, failure = self._run_in_child(run_candidate, candidate)
                    if again is None:
                        return candidate
                    if isinstance(failure, PlanningError) or not self._continue_as(again):
                        self._result.add_failure(PlanningError("branch", "crashed"))
        finally:
            self._kill_children()

    def _run_in_child(
        self, run_candidate: Callable[[T], float], candidate: T
    ) -> tuple[ForkedProcess | None, float | PlanningError]:
        """Run a candidate in a child process; return the child, and the candidate's score or error.

        In the child process the method returns (None, 0.0), as soon as the child has to continue the episode.
        """
        for last in (False, True):
            child = self._fork()
            if child is None:
                self._run_and_wait(run_candidate, candidate)
                return None, 0.0
            try:
                outcome = self._receive(child, CANDIDATE_TIMEOUT)
            except ForkedProcessError as error:
                outcome = PlanningError("branch", str(error))
                if isinstance(error, ForkedProcessCrashError) and not last:
                    self._kill(child)
                    continue
            break
        if isinstance(outcome, PlanningError):
            self._kill(child)
        return child, outcome

    def _fork(self) -> ForkedProcess | None:
        """Fork this process; return the child process in the parent, and None in the child."""
        parent = os.getpid()
        # an interrupt between fork and set-up would leave a child unknown to the parent, or one that acts as the root
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            forked = fork()
            if isinstance(forked, ForkedProcess):
                self._children.append(forked)
                return forked
            inherited = [*(child.pipe for child in self._children), *([self._pipe] if self._pipe else [])]
            self._pipe, self._children = forked, []
            set_up_forked_process(parent)
            for pipe in inherited:
                pipe.close()
            return None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _continue_as(self, child: ForkedProcess) -> bool:
        """Let a child continue the episode.

        Returns:
            True if the episode failed; False if the child crashed.

        Raises:
            _EpisodeFinished: the episode succeeded.
        """
        try:
            child.send(self._result)
            succeeded = self._receive(child, EPISODE_TIMEOUT)
        except ForkedProcessCrashError:
            return False
        except ForkedProcessError as error:
            self._result.add_failure(PlanningError("branch", str(error)))
            return True
        finally:
            self._kill(child)
        if succeeded:
            raise _EpisodeFinished
        return True

    def _receive(self, child: ForkedProcess, limit: float) -> Any:
        answer, result = child.receive(limit)
        if isinstance(answer, RemoteError):
            answer.reraise()
        self._result.copy_from(result)
        return answer

    def _kill(self, child: ForkedProcess) -> None:
        self._children.remove(child)
        child.kill()

    def _kill_children(self) -> None:
        for child in list(self._children):
            self._kill(child)

    def _run_and_wait(self, run_candidate: Callable[[T], float], candidate: T) -> None:
        try:
            score = float(run_candidate(candidate))
        except PlanningError as error:
            self._send_and_exit(error)
        except BaseException as error:
            self._send_and_exit(RemoteError.from_error(error, "a branch"))
        assert self._pipe is not None
        try:
            self._pipe.send((score, self._result))
            self._result.copy_from(self._pipe.recv())
        except (EOFError, ConnectionError):
            os._exit(0)

    def _send_and_exit(self, answer: bool | PlanningError | RemoteError) -> NoReturn:
        assert self._pipe is not None
        try:
            self._kill_children()
            self._pipe.send((answer, self._result))
        except Exception:  # noqa: BLE001  (the parent has ended)
            if isinstance(answer, RemoteError):
                _log.error("a branch failed\n%s", answer.traceback)
        finally:  # even an interrupt must not return to the code that the parent runs too
            os._exit(0)
