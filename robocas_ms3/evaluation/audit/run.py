"""Replay of the episodes of a result, with a record that lets an interrupted audit continue."""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.stats import hypergeom

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import FolderKind, OutputFolder
from robocas_ms3.core.source_hash import hash_source
from robocas_ms3.evaluation.audit.differences import (
    list_deviations,
    list_differences,
    list_large_differences,
    list_state_differences,
)
from robocas_ms3.evaluation.audit.stored_actions import NO_ACTIONS_LEFT, CheckpointEnv, StoredActionsPolicy
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol, ProtocolEpisode
from robocas_ms3.evaluation.results.outcomes import Count, EvaluatedEpisode, Outcome, find_failure_stage
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.results.run_record import (
    describe_machine,
    get_package_versions,
    is_same_processor,
)
from robocas_ms3.evaluation.rollouts.rollout import count_checkpoint_steps
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings
from robocas_ms3.scenes.task_specs import TASKS

OUTPUT = FolderKind("robocas eval audit", ("audit.json",), "result_hash")
_EPISODES = "episodes.jsonl"
_CONFIDENCE = 0.95

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


class AuditPlan(NamedTuple):
    """Episodes that an audit replays.

    Attributes:
        episodes: numbers of the episodes.
        seed: random seed by which they were chosen.
        candidates: number of episodes from which they were chosen.
        replayed_before: number of these episodes that were replayed in an earlier run of the audit.
    """

    episodes: list[int]
    seed: int
    candidates: int
    replayed_before: int


@dataclass(frozen=True)
class AuditSummary:
    """Outcome of an audit: its plan, and the replayed episodes."""

    plan: AuditPlan
    episodes: list[AuditedEpisode]

    @property
    def differences(self) -> list[str]:
        """Return a text per difference."""
        modes = {"exact": "", "checkpoints": " (from checkpoint to checkpoint)"}
        return [
            f"episode {one.episode}, recorded -> replayed{modes[one.mode]}: {text}"
            for one in self.episodes
            for text in one.differences
        ]

    @property
    def with_tolerances(self) -> int:
        """Return the number of episodes that were replayed from checkpoint to checkpoint."""
        return list(self.modes.values()).count("checkpoints")

    @property
    def modes(self) -> dict[int, Mode]:
        """Return how each episode was replayed, by its number."""
        return {one.episode: one.mode for one in self.episodes}


def list_other_processors(result: Result) -> list[str]:
    """Return the models of other processors than that of this machine that made a result."""
    machines = [part.machine for part in result.run.merged_from] or [result.run.machine]
    return sorted({str((machine or {}).get("model")) for machine in machines if not is_same_processor(machine or {})})


def find_audit_obstacle(result: Result, stored: Collection[int] | None = None) -> str:
    """Return why the episodes of a result cannot be replayed; empty if they can.

    Versions of packages must be equal, without their local part, such as ``+cpu``. The version of robocas_ms3 may
    differ: then the outcomes decide.

    Args:
        result: the result.
        stored: numbers of the episodes whose actions are stored; None: all.
    """
    if result.run.backend != "processes":
        return f"its backend is {result.run.backend}, whose physics is not repeatable; expected processes"
    if not choose_episodes(result, None, 0, stored):
        return "it has no episode that can be replayed"
    recorded = {name: version.partition("+")[0] for name, version in result.run.versions.items()}
    installed = {name: version.partition("+")[0] for name, version in get_package_versions().items()}
    del installed["robocas_ms3"]
    if differing := [name for name in installed if recorded.get(name, installed[name]) != installed[name]]:
        names = ", ".join(f"{name} {recorded[name]}" for name in differing)
        return f"it was made with other versions: {names}. Install these versions"
    return ""


def choose_episodes(result: Result, sample: int | None, seed: int, stored: Collection[int] | None = None) -> list[int]:
    """Return the numbers of the episodes to replay, in ascending order.

    Episodes that ended with an error before their first action are left out.

    Args:
        result: the result.
        sample: number of episodes to choose at random; None: all.
        seed: random seed of the choice.
        stored: numbers of the episodes whose actions are stored; None: all.
    """
    numbers = [
        number
        for number, outcome in result.outcomes.items()
        if (outcome.steps or not outcome.error) and (stored is None or number in stored)
    ]
    if sample is None or sample >= len(numbers):
        return numbers
    return sorted(np.random.default_rng(seed).choice(numbers, sample, replace=False).tolist())


def run_audit(
    result: Result,
    protocol: LoadedProtocol,
    out: Path,
    *,
    sample: int | None = None,
    seed: int | None = None,
    stored: Collection[int] | None = None,
    envs: int = 2,
    overwrite: bool = False,
    on_start: Callable[[AuditPlan], None] = lambda plan: None,
) -> Iterator[AuditedEpisode]:
    """Replay episodes of a result and yield each. An interrupted audit is continued.

    Args:
        result: the result, without violations (`verify`).
        protocol: its protocol.
        out: folder of the audit. It must not come from the author of the result.
        sample: number of episodes to replay, chosen at random; None: all (`choose_episodes`).
        seed: random seed of the choice; None: that of the audit in ``out``, or a number that nobody can predict.
        stored: numbers of the episodes whose actions are stored; None: all.
        envs: number of environments that run at the same time.
        overwrite: whether to delete an earlier audit.
        on_start: is called before the first episode.

    Raises:
        OutputExistsError: ``out`` has an audit of another result, with other code, or on another processor.
        EvaluationError: an episode could not be replayed, for example because its worker process crashed.
    """
    code = {"versions": get_package_versions(), "source_hash": hash_source(), "machine": describe_machine()}
    settings = {"result_hash": hash_result(result), **code}
    with OutputFolder(out, OUTPUT, settings, overwrite=overwrite) as output:
        earlier = None if overwrite or output.recorded is None else int(output.recorded["seed"])
        seed = seed if seed is not None else secrets.randbits(32) if earlier is None else earlier
        output.start({**settings, "seed": seed})
        file = JsonLinesFile[AuditedEpisode](output.path / _EPISODES, AuditedEpisode)
        replayed, chosen = {one.episode: one for one in file.read()}, choose_episodes(result, sample, seed, stored)
        candidates = len(choose_episodes(result, None, seed, stored))
        on_start(AuditPlan(chosen, seed, candidates, len(replayed.keys() & set(chosen))))
        yield from (replayed[number] for number in chosen if number in replayed)
        episodes = [protocol.episodes[number] for number in chosen if number not in replayed]
        for one in _replay(result, protocol, episodes, envs) if episodes else ():
            file.append([one])
            yield one


def _replay(
    result: Result, protocol: LoadedProtocol, episodes: Sequence[ProtocolEpisode], envs: int
) -> Iterator[AuditedEpisode]:
    """Replay episodes; those of another processor that differ are replayed again from checkpoint to checkpoint."""
    may_diverge, diverged = bool(list_other_processors(result)), []
    with closing(_open_session(result, protocol, envs, StoredActionsPolicy(result))) as session:
        period = count_checkpoint_steps(1 / session.rate)
        for replayed in _run_episodes(session, episodes):
            number = replayed.outcome.episode
            recorded = result.read_checkpoints(number)
            differences = list_differences(result.outcomes[number], replayed.outcome)
            differences = differences or list_state_differences(recorded, replayed.checkpoints)
            has_states = recorded.states.shape[1:] == replayed.checkpoints.states.shape[1:]
            if differences and may_diverge and has_states:
                diverged.append(protocol.episodes[number])
            else:
                yield AuditedEpisode(number, differences)
    if diverged:
        yield from _replay_checkpoints(result, protocol, diverged, envs, period)


def _replay_checkpoints(
    result: Result, protocol: LoadedProtocol, episodes: Sequence[ProtocolEpisode], envs: int, period: int
) -> Iterator[AuditedEpisode]:
    policy, opened = StoredActionsPolicy(result, repeats=period), list[CheckpointEnv]()

    def wrap(env: Any) -> CheckpointEnv:
        opened.append(CheckpointEnv(env, policy, result))
        return opened[-1]

    with closing(_open_session(result, protocol, envs, policy, wrap)) as session:
        for replayed in _run_episodes(session, episodes):
            number = replayed.outcome.episode
            deviations = opened[-1].deviations.get(number, [])
            outcome = _replace_stages(replayed.outcome, opened[-1].lost_stages.get(number, {}), 1 / session.rate)
            differences = list_large_differences(result.outcomes[number], outcome, period)
            differences += list_deviations(result.read_checkpoints(number), deviations, period)
            yield AuditedEpisode(number, differences, "checkpoints")


def _replace_stages(outcome: Outcome, stages: Mapping[str, tuple[int, int] | None], control_dt: float) -> Outcome:
    """Return an outcome with other times of some stages, given as policy step and control step (`CheckpointEnv`)."""
    flags = {**outcome.flags, **{name: None if at is None else at[0] for name, at in stages.items()}}
    seconds = {name: None if at is None else round(at[1] * control_dt, 4) for name, at in stages.items()}
    failure_stage = find_failure_stage(flags, outcome.error, TASKS[outcome.task].stages)
    return replace(outcome, flags=flags, flag_seconds={**outcome.flag_seconds, **seconds}, failure_stage=failure_stage)


def _open_session(
    result: Result,
    protocol: LoadedProtocol,
    envs: int,
    policy: StoredActionsPolicy,
    wrap: Callable[[Any], Any] = lambda env: env,
) -> EvaluationSession:
    run = result.run
    settings = EvaluationSettings(
        tasks=tuple(run.played_as),
        policy="audit",
        protocol=str(protocol.folder),
        weld=run.weld,
        action_noise=run.action_noise or (0.0, 0.0),
        envs=envs,
        backend="processes",
    )
    return EvaluationSession(policy, settings, wrap)


def _run_episodes(session: EvaluationSession, episodes: Sequence[ProtocolEpisode]) -> Iterator[EvaluatedEpisode]:
    """Run episodes; raise `EvaluationError` if one ends with another error than that the stored actions end."""
    for replayed in session.run_episodes(episodes):
        if (error := replayed.outcome.error) not in ("", NO_ACTIONS_LEFT):
            where, fix = f"episode {replayed.outcome.episode}", "Run the same command again."
            raise EvaluationError("an episode could not be replayed", where=where, found=error, fix=fix)
        yield replayed


def hash_result(result: Result) -> str:
    """Return the hex SHA-256 of the settings, the outcomes with the hashes of the actions, and the checkpoints."""
    run = result.run.model_copy(update={"merged_from": []})
    digest = hashlib.sha256(json.dumps(run.to_dict(), sort_keys=True).encode())
    for number, outcome in result.outcomes.items():
        digest.update(json.dumps(asdict(outcome), sort_keys=True).encode())
        for array in result.read_checkpoints(number):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def hash_audit(result: Result) -> str:
    """Return the hex SHA-256 of a result and of the code that replays it: package versions, source code, processor."""
    code = [get_package_versions(), hash_source(), describe_machine()]
    return hashlib.sha256(f"{hash_result(result)} {json.dumps(code, sort_keys=True)}".encode()).hexdigest()


def bound_differing_episodes(sample: int, total: int) -> int:
    """Return the greatest number of differing episodes that a sample without differences does not exclude.

    With at least one more among the ``total`` episodes, a random sample would show one with a probability of at least
    95 %.
    """
    differing = np.arange(total - sample + 1)
    unseen = hypergeom.pmf(0, total, differing, sample)  # probability that the sample has none of them
    return int(differing[unseen > 1 - _CONFIDENCE].max())
