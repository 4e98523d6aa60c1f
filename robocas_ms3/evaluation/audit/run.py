"""Audit of a result: replay the stored actions in the frozen scenes, and compare outcomes and checkpoints.

An audit shows that the stored actions have the recorded outcomes. It does not show which policy chose the actions.
Neither the policy nor a renderer is needed. All values must be equal, except wall-clock times. This holds on the
processor model of the result; on other models, contacts may diverge.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import hypergeom

from robocas_ms3.core.errors import EvaluationError, PolicyError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import FolderKind, OutputFolder, list_setting_changes
from robocas_ms3.evaluation.outcomes import Checkpoints, Count, Outcome
from robocas_ms3.evaluation.policy import CONVENTIONS, EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.protocol import LoadedProtocol, ProtocolEpisode
from robocas_ms3.evaluation.results import Result
from robocas_ms3.evaluation.run_record import describe_machine, get_package_versions, hash_source
from robocas_ms3.evaluation.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

OUTPUT = FolderKind("robocas eval audit", ("audit.json",), "result_hash")
_EPISODES = "episodes.jsonl"
_CONFIDENCE = 0.95
_NO_ACTIONS_LEFT = "the stored actions end before the episode"


@dataclass(frozen=True)
class AuditedEpisode:
    """Episode that was replayed: a line of ``episodes.jsonl`` of an audit.

    Attributes:
        episode: number of the episode in the protocol.
        differences: differences between the recorded outcome and checkpoints, and those of the stored actions.
    """

    episode: Count
    differences: list[str]


class AuditPlan(NamedTuple):
    """Episodes that an audit replays.

    Attributes:
        episodes: numbers of the episodes.
        seed: random seed by which they were chosen.
        replayed: number of these episodes that were replayed in an earlier run of the audit.
    """

    episodes: list[int]
    seed: int
    replayed: int


class StoredActionsPolicy:
    """Policy that sends the stored actions of a result. It observes nothing.

    An episode that needs more actions ends with an error.

    Args:
        result: the result.
    """

    def __init__(self, result: Result) -> None:
        self._result, values = result, result.run.policy.spec
        motion = {name: values[name] for name in ("convention", "reference", "rate_hz") if name in values}
        self.spec = PolicySpec(**motion, language="none")
        self._actions: dict[int, Iterator[NDArray[np.float32]]] = {}  # by env

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._actions[episode.env] = iter(self._result.read_actions(episode.episode))

    def act(self, observations: Observations) -> NDArray[np.float32]:
        """Return one action per env (E, A)."""
        envs = observations.envs.tolist()
        actions = np.zeros((len(envs), CONVENTIONS[self.spec.convention].size), np.float32)
        missing = {}
        for row, env in enumerate(envs):
            action = next(self._actions[env], None)
            if action is None:
                missing[env] = _NO_ACTIONS_LEFT
            else:
                actions[row] = action
        if missing:
            raise PolicyError(missing, actions)
        return actions


def list_other_processors(result: Result) -> list[str]:
    """Return the models of the processors that made a result, without the model of this machine."""
    machines = [part.machine for part in result.run.merged_from] or [result.run.machine]
    return sorted({(machine or {}).get("model", "") for machine in machines} - {"", describe_machine()["model"]})


def find_audit_obstacle(result: Result) -> str:
    """Return why the episodes of a result cannot be replayed; empty if they can."""
    if result.run.backend != "processes":
        return f"its backend is {result.run.backend}, whose physics is not repeatable; expected processes"
    if not choose_episodes(result, None, 0):
        return "it has no episode that can be replayed"
    installed, recorded = get_package_versions(), result.run.versions
    if differing := [name for name in recorded if name in installed and installed[name] != recorded[name]]:
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
        OutputExistsError: ``out`` has an audit of another result, or with other versions.
        EvaluationError: an episode could not be replayed, for example because its worker process crashed.
    """
    settings = {"result_hash": hash_result(result), "versions": get_package_versions()}
    with OutputFolder(out, OUTPUT, settings, overwrite=overwrite) as output:
        earlier = None if overwrite or output.recorded is None else int(output.recorded["seed"])
        seed = seed if seed is not None else secrets.randbits(32) if earlier is None else earlier
        output.start({**settings, "seed": seed})
        file = JsonLinesFile[AuditedEpisode](output.path / _EPISODES, AuditedEpisode)
        replayed, chosen = {one.episode: one for one in file.read()}, choose_episodes(result, sample, seed, stored)
        on_start(AuditPlan(chosen, seed, len(replayed.keys() & set(chosen))))
        yield from (replayed[number] for number in chosen if number in replayed)
        episodes = [protocol.episodes[number] for number in chosen if number not in replayed]
        for number, differences in _replay(result, protocol, episodes, envs) if episodes else ():
            file.append([AuditedEpisode(number, differences)])
            yield AuditedEpisode(number, differences)


def _replay(
    result: Result, protocol: LoadedProtocol, episodes: Sequence[ProtocolEpisode], envs: int
) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the differences of each episode."""
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
    with closing(EvaluationSession(StoredActionsPolicy(result), settings)) as session:
        for replayed in session.run_episodes(episodes):
            number, error = replayed.outcome.episode, replayed.outcome.error
            if error not in ("", _NO_ACTIONS_LEFT):
                where, fix = f"episode {number}", "Run the same command again."
                raise EvaluationError("an episode could not be replayed", where=where, found=error, fix=fix)
            differences = list_differences(result.outcomes[number], replayed.outcome)
            yield number, differences or list_state_differences(result.read_checkpoints(number), replayed.checkpoints)


def list_differences(recorded: Outcome, replayed: Outcome) -> list[str]:
    """Return a text per value of a recorded outcome that differs from that of the stored actions."""
    before, now = recorded.reproducible_values(), replayed.reproducible_values()
    if before["error"]:  # an error of the policy cannot be repeated, but it ends the episode after the last action
        before["error"] = _NO_ACTIONS_LEFT
    return [change for key in now for change in list_setting_changes(before[key], now[key], key)]


def list_state_differences(recorded: Checkpoints, replayed: Checkpoints) -> list[str]:
    """Return a text for the first recorded checkpoint that differs; without recorded checkpoints []."""
    if not len(recorded.steps):
        return []
    if recorded.states.shape != replayed.states.shape or (recorded.steps != replayed.steps).any():
        return [f"checkpoints: steps {recorded.steps.tolist()} -> {replayed.steps.tolist()}"]
    differing = recorded.steps[(recorded.states != replayed.states).any(axis=1)]
    return [f"checkpoints: another state after step {differing[0]}"] if len(differing) else []


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
    code = [get_package_versions(), hash_source(), describe_machine()["model"]]
    return hashlib.sha256(f"{hash_result(result)} {json.dumps(code, sort_keys=True)}".encode()).hexdigest()


def bound_differing_episodes(sample: int, total: int) -> int:
    """Return the greatest number of differing episodes that a sample without differences does not exclude.

    With at least one more among the ``total`` episodes, a random sample would show one with a probability of at least
    95 %.
    """
    differing = np.arange(total - sample + 1)
    unseen = hypergeom.pmf(0, total, differing, sample)  # probability that the sample has none of them
    return int(differing[unseen > 1 - _CONFIDENCE].max())
