"""Replay of single episodes of a result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NoReturn

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.evaluation.audit.differences import (
    list_deviations,
    list_differences,
    list_large_differences,
    list_state_differences,
)
from robocas_ms3.evaluation.audit.obstacles import list_other_processors
from robocas_ms3.evaluation.audit.stored_actions import (
    NO_ACTIONS_LEFT,
    CheckpointEnv,
    CheckpointLog,
    StoredActionsPolicy,
)
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.outcomes import Count, EvaluatedEpisode, Outcome, find_failure_stage
from robocas_ms3.evaluation.results.result_files import read_result
from robocas_ms3.evaluation.rollouts.rollout import count_checkpoint_steps
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings
from robocas_ms3.scenes.task_specs import TASKS

Mode = Literal["exact", "checkpoints"]
"""How an episode was replayed: without interruption, or from checkpoint to checkpoint (`CheckpointEnv`)."""


@dataclass(frozen=True)
class AuditedEpisode:
    """Episode that was replayed: a line of ``episodes.jsonl`` of an audit.

    Attributes:
        episode: number of the episode in the protocol.
        differences: differences between the recorded outcome and checkpoints, and those of the stored actions.
        mode: how it was replayed. In the mode ``checkpoints``, small differences count as none
            (`list_large_differences`).
    """

    episode: Count
    differences: list[str]
    mode: Mode = "exact"


class EpisodeReplayer:
    """Worker (`core.workers.Worker`) that replays episodes of a result, each in one environment in this process.

    Args:
        folder: folder of the result.
        protocol: folder of its protocol.
    """

    def __init__(self, folder: Path, protocol: Path) -> None:
        use_one_torch_thread()
        self._result, self._protocol = read_result(folder), load_protocol(str(protocol))
        self._may_diverge = bool(list_other_processors(self._result))
        self._session = self._open_session(StoredActionsPolicy(self._result))
        self._period = count_checkpoint_steps(1 / self._session.rate)
        self._log = CheckpointLog()
        policy = StoredActionsPolicy(self._result, repeats=self._period)
        self._checkpoint_session = self._open_session(
            policy, lambda env: CheckpointEnv(env, policy, self._result, self._log)
        )

    def run(self, number: int) -> AuditedEpisode:
        """Replay an episode; one of another processor that differs is replayed again from checkpoint to checkpoint.

        Raises:
            EvaluationError: the episode ended with another error than that the stored actions end.
        """
        replayed, recorded = self._run_episode(self._session, number), self._result.read_checkpoints(number)
        differences = list_differences(self._result.outcomes[number], replayed.outcome)
        differences = differences or list_state_differences(recorded, replayed.checkpoints)
        has_states = recorded.states.shape[1:] == replayed.checkpoints.states.shape[1:]
        if differences and self._may_diverge and has_states:
            return self._replay_checkpoints(number)
        return AuditedEpisode(number, differences)

    def close(self) -> None:
        """Close the environments."""
        self._session.close()
        self._checkpoint_session.close()

    def _replay_checkpoints(self, number: int) -> AuditedEpisode:
        replayed = self._run_episode(self._checkpoint_session, number).outcome
        outcome = self._replace_stages(replayed, self._log.lost_stages.get(number, {}))
        differences = list_large_differences(self._result.outcomes[number], outcome, self._period)
        recorded, deviations = self._result.read_checkpoints(number), self._log.deviations.get(number, [])
        differences += list_deviations(recorded, deviations, self._period)
        return AuditedEpisode(number, differences, "checkpoints")

    def _run_episode(self, session: EvaluationSession, number: int) -> EvaluatedEpisode:
        (replayed,) = session.run_episodes([self._protocol.episodes[number]])
        if (error := replayed.outcome.error) not in ("", NO_ACTIONS_LEFT):
            raise_not_replayed(number, error)
        return replayed

    def _replace_stages(self, outcome: Outcome, stages: Mapping[str, tuple[int, int] | None]) -> Outcome:
        """Return an outcome with other times of some stages, given as policy and control step (`CheckpointLog`)."""
        control_dt = 1 / self._session.rate
        flags = {**outcome.flags, **{name: None if at is None else at[0] for name, at in stages.items()}}
        seconds = {name: None if at is None else round(at[1] * control_dt, 4) for name, at in stages.items()}
        task = self._protocol.episodes[outcome.episode].task
        failure_stage = find_failure_stage(flags, outcome.error, TASKS[task].stages)
        seconds = {**outcome.flag_seconds, **seconds}
        return replace(outcome, flags=flags, flag_seconds=seconds, failure_stage=failure_stage)

    def _open_session(
        self, policy: StoredActionsPolicy, wrap: Callable[[Any], Any] = lambda env: env
    ) -> EvaluationSession:
        run = self._result.run
        settings = EvaluationSettings(
            tasks=tuple(run.played_as),
            policy="audit",
            protocol=str(self._protocol.folder),
            weld=run.weld,
            action_noise=run.action_noise or (0.0, 0.0),
            envs=1,
            workers=0,
            backend="processes",
        )
        return EvaluationSession(policy, settings, wrap)


def raise_not_replayed(number: int, error: str) -> NoReturn:
    """Raise `EvaluationError`: an episode could not be replayed because of an error."""
    where, fix = f"episode {number}", "Run the same command again."
    raise EvaluationError("an episode could not be replayed", where=where, found=error, fix=fix)
