"""Episodes of a protocol for somebody else's loop, one at a time: it resets and steps, and is told what is seen.

Beneath is the loop of `rollout`, in a thread, with a policy that hands out what it sees and waits for actions. So
steps, ends and measures are those of ``robocas eval``, to the bit.
"""

from __future__ import annotations

import queue
import threading
from typing import Any

from numpy.typing import ArrayLike

from robocas_ms3.datasets.writing.render import require_renderer
from robocas_ms3.errors import EvaluationError, PolicyFailed
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.policy import Observations, Start, Wants
from robocas_ms3.evaluation.protocol import Episode, LoadedProtocol
from robocas_ms3.evaluation.rollout import Rollouts, Rules
from robocas_ms3.evaluation.run import Settings, about
from robocas_ms3.evaluation.stage import make_env, object_ids, rate_of, start_of


class DrivenEpisodes:
    """Plays episodes in one env, in a process of its own, which stays as long as the configuration does.

    Args:
        protocol: whose episodes.
        wants: what the harness' policy wants to see, and speaks.

    Raises:
        EvaluationError: that does not fit the protocol, or the object pack is another.
        DatasetError: it wants to see, and there is no render device.
    """

    def __init__(self, protocol: LoadedProtocol, wants: Wants) -> None:
        protocol.rules.refuse(wants)
        if wants.cameras:
            require_renderer()
        self.protocol, self.rate = protocol, rate_of(protocol, wants)
        self.outcome: Outcome | None = None
        self._policy = _HarnessPolicy(wants)
        self.about: dict[str, Any] = about(protocol, self._policy, "", Settings(backend="processes"))
        self._env: Any = None
        self._config = ""
        self._thread: threading.Thread | None = None

    def max_steps(self, task: str) -> int:
        """Policy steps that an episode of a task may have."""
        steps = self.protocol.rules.steps(task, self.rate)
        assert steps is not None  # `load_protocol` saw to it
        return steps

    def reset(self, number: int) -> Observations:
        """Begin an episode of the protocol's list; one that plays is broken off.

        Returns:
            What is seen, of one env.

        Raises:
            EvaluationError: there is no such episode.
        """
        self._break_off()
        if not 0 <= number < len(self.protocol.episodes):
            expected = f"0 to {len(self.protocol.episodes) - 1}"
            raise EvaluationError("no such episode", where=self.protocol.rules.name, expected=expected, found=number)
        self._thread = threading.Thread(target=self._play, args=(self.protocol.episodes[number],), daemon=True)
        self._thread.start()
        seen = self._next()
        assert seen is not None  # a policy is asked before anything can end
        return seen

    def step(self, actions: ArrayLike) -> Observations | None:
        """Go on.

        Args:
            actions: (1, A), or a chunk (1, H, A), all of which is played.

        Returns:
            What is seen; None: the episode is over, and `outcome` says what came of it.

        Raises:
            EvaluationError: no episode plays, or the actions have another shape; the episode is over then, too.
        """
        if self._thread is None:
            raise EvaluationError("no episode plays", fix="Reset first.")
        self._policy.given.put(actions)
        return self._next()

    def close(self) -> None:
        """Break off what plays, and end the env's process."""
        self._break_off()
        self._close_env()

    def _next(self) -> Observations | None:
        said = self._policy.said.get()
        if isinstance(said, Observations):
            return said
        assert self._thread is not None
        self._thread.join()
        self._thread = None
        if isinstance(said, Exception):
            raise said
        self.outcome = said
        return None

    def _break_off(self) -> None:
        if self._thread is not None:
            self._policy.given.put(None)
            self._next()
        self.outcome = None

    def _play(self, episode: Episode) -> None:
        """Play an episode; runs in the thread."""
        rules, said = self.protocol.rules, self._policy.said
        try:
            env = self._env_of(episode)
            ends = Rules(self.max_steps(episode.task), tuple(rules.ends_on), rules.max_v0_steps)
            start = start_of(self.protocol, episode)
            (played,) = Rollouts(env, self._policy, ends, 1 / self.rate, refill=True).play([start])
            said.put(Outcome.of(played, episode, object_ids(self.protocol, episode)))
        except Exception as error:  # of an env, or actions that don't fit; the harness' thread raises it
            try:
                self._close_env()
            finally:
                said.put(error)

    def _env_of(self, episode: Episode) -> Any:
        if self._config != episode.config:
            self._close_env()
            self._env = make_env(self.protocol, self._policy.wants, episode, 1, backend="processes")
            self._config = episode.config
        return self._env

    def _close_env(self) -> None:
        env, self._env, self._config = self._env, None, ""
        if env is not None:
            env.close()


class _HarnessPolicy:
    """A policy whose actions come from elsewhere."""

    def __init__(self, wants: Wants) -> None:
        self.wants = wants
        self.said: queue.SimpleQueue[Observations | Outcome | Exception] = queue.SimpleQueue()
        self.given: queue.SimpleQueue[Any] = queue.SimpleQueue()  # actions; None: the episode is broken off

    def reset(self, starts: list[Start]) -> None:
        """Nothing to begin: the harness began it."""

    def act(self, observations: Observations) -> Any:
        """Hand out what is seen, and wait."""
        self.said.put(observations)
        actions = self.given.get()
        if actions is None:
            raise PolicyFailed(dict.fromkeys(observations.envs.tolist(), "the harness broke it off"))
        return actions
