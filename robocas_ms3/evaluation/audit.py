"""Audit of a result: play the stored actions again in the frozen scenes, and compare outcomes and checkpoints.

An audit shows that the stored actions have the recorded outcomes. It does not show which policy chose the actions.
Neither the policy nor a renderer is needed.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import hypergeom

from robocas_ms3.core.errors import PolicyError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import FolderKind, OutputFolder, list_setting_changes
from robocas_ms3.evaluation.outcomes import Checkpoints, Count, Outcome
from robocas_ms3.evaluation.policy import CONVENTIONS, EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.results import Result, get_package_versions
from robocas_ms3.evaluation.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

OUTPUT = FolderKind("robocas eval audit", ("audit.json",), "audited_protocol_hash")
_EPISODES = "episodes.jsonl"
_CONFIDENCE = 0.95
_ENDED = "the stored actions end before the episode"


@dataclass(frozen=True)
class AuditedEpisode:
    """Episode that was played again: a line of ``episodes.jsonl`` of an audit.

    Attributes:
        episode: number of the episode in the protocol.
        outcome_hash: hash of the recorded outcome (`hash_outcome`).
        differences: differences between the recorded outcome and that of the stored actions.
    """

    episode: Count
    outcome_hash: str
    differences: list[str]


class AuditPlan(NamedTuple):
    """Numbers of the episodes to play, and the random seed by which they were chosen."""

    numbers: list[int]
    seed: int


class StoredActionsPolicy:
    """Policy that sends the stored actions of a result. It observes nothing.

    An episode that needs more actions ends with an error.

    Args:
        result: the result.
    """

    def __init__(self, result: Result) -> None:
        self._result, values = result, result.run.policy.spec
        known = {name: values[name] for name in ("convention", "reference", "rate_hz") if name in values}
        self.spec = PolicySpec(**known, language="none")
        self._actions: dict[int, Iterator[NDArray[np.float32]]] = {}  # by env

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._actions[episode.env] = iter(self._result.read_actions(episode.episode))

    def act(self, observations: Observations) -> NDArray[np.float32]:
        """Return one action per env (E, A)."""
        envs = observations.envs.tolist()
        found = {env: next(self._actions[env], None) for env in envs}
        none = np.zeros(CONVENTIONS[self.spec.convention].size, np.float32)
        actions = np.stack([none if (action := found[env]) is None else action for env in envs])
        if missing := {env: _ENDED for env in envs if found[env] is None}:
            raise PolicyError(missing, actions)
        return actions


def find_audit_obstacle(result: Result) -> str:
    """Return why the episodes of a result cannot be played again; empty if they can."""
    if result.run.backend != "processes":
        return f"its backend is {result.run.backend}, whose physics is not repeatable; expected processes"
    here = get_package_versions()
    differing = [name for name, of in result.run.versions.items() if name in here and here[name] != of]
    if differing:
        recorded = ", ".join(f"{name} {result.run.versions[name]}" for name in differing)
        return f"it was made with other versions: {recorded}. Install these versions"
    return ""


def choose_episodes(result: Result, sample: int | None, seed: int) -> list[int]:
    """Return the numbers of the episodes to play again, in ascending order.

    Episodes that ended with an error are left out. They count as failed, and errors cannot be repeated.

    Args:
        result: the result.
        sample: number of episodes to choose at random; None: all.
        seed: random seed of the choice.
    """
    numbers = [number for number, outcome in result.outcomes.items() if not outcome.error]
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
    envs: int = 2,
    overwrite: bool = False,
    on_start: Callable[[AuditPlan], None] = lambda plan: None,
) -> Iterator[AuditedEpisode]:
    """Play episodes of a result again and yield each. An interrupted audit is continued.

    An episode whose recorded outcome was changed since is played again.

    Args:
        result: the result.
        protocol: its protocol.
        out: folder of the audit. It should not be part of the result, which may come from somebody else.
        sample: number of episodes to play, chosen at random; None: all (`choose_episodes`).
        seed: random seed of the choice; None: that of the audit in ``out``, or a number that nobody can predict.
        envs: number of environments that run at the same time.
        overwrite: whether to delete an earlier audit.
        on_start: is called with the chosen episodes before the first is played.

    Raises:
        OutputExistsError: ``out`` has an audit with another protocol or other versions.
        EvaluationError: stored actions are missing or damaged.
    """
    settings = {"audited_protocol_hash": protocol.hash, "versions": get_package_versions()}
    with OutputFolder(out, OUTPUT, settings, overwrite=overwrite) as output:
        recorded = None if overwrite or output.recorded is None else output.recorded["seed"]
        if seed is None:
            seed = secrets.randbits(32) if recorded is None else int(recorded)
        output.start({**settings, "seed": seed})
        numbers = choose_episodes(result, sample, seed)
        on_start(AuditPlan(numbers, seed))
        file = JsonLinesFile[AuditedEpisode](output.path / _EPISODES, AuditedEpisode)
        known = {(one.episode, one.outcome_hash): one for one in file.read()}
        waiting = []
        for number in numbers:
            before = known.get((number, hash_outcome(result.outcomes[number])))
            if before is None:
                waiting.append(number)
            else:
                yield before
        if not waiting:
            return
        run = result.run
        session = EvaluationSession(
            StoredActionsPolicy(result),
            EvaluationSettings(
                tasks=tuple(run.played_as),
                policy="audit",
                protocol=str(protocol.folder),
                weld=run.weld,
                action_noise=run.action_noise or (0.0, 0.0),
                envs=envs,
                backend="processes",
            ),
        )
        with closing(session):
            for evaluated in session.run_episodes([protocol.episodes[number] for number in waiting]):
                recorded = result.outcomes[evaluated.outcome.episode]
                differences = list_differences(recorded, evaluated.outcome)
                differences += list_state_differences(result.read_checkpoints(recorded.episode), evaluated.checkpoints)
                audited = AuditedEpisode(recorded.episode, hash_outcome(recorded), differences)
                file.append([audited])
                yield audited


def list_differences(recorded: Outcome, played: Outcome) -> list[str]:
    """Return a text per value of a recorded outcome that differs from the outcome of its stored actions."""
    before, now = recorded.reproducible_values(), played.reproducible_values()
    return [change for key in now for change in list_setting_changes(before[key], now[key], key)]


def list_state_differences(recorded: Checkpoints, played: Checkpoints) -> list[str]:
    """Return a text if recorded checkpoints differ from those of the stored actions; no recorded ones never differ."""
    if not len(recorded.steps):
        return []
    if recorded.states.shape != played.states.shape or (recorded.steps != played.steps).any():
        return [f"{len(recorded.steps)} checkpoints {recorded.states.shape} -> {played.states.shape}"]
    differing = recorded.steps[(recorded.states != played.states).any(axis=1)]
    return [f"the state after step {differing[0]} differs"] if len(differing) else []


def hash_outcome(outcome: Outcome) -> str:
    """Return the hex SHA-256 of the values of an outcome, with the hash of its actions."""
    return hashlib.sha256(json.dumps(asdict(outcome), sort_keys=True).encode()).hexdigest()


def bound_differing_episodes(sample: int, total: int) -> int:
    """Return the greatest number of differing episodes that a sample without differences does not exclude.

    With at least one more among the ``total`` episodes, a random sample would show one with a probability of at least
    95 %.
    """
    differing = np.arange(total - sample + 1)
    unseen = hypergeom.pmf(0, total, differing, sample)  # probability that the sample has none of them
    return int(differing[unseen > 1 - _CONFIDENCE].max())
