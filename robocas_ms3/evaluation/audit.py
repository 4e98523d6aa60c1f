"""Audit of a result: replay the stored actions in the frozen scenes, and compare outcomes and checkpoints.

An audit shows that the stored actions have the recorded outcomes. It does not show which policy chose the actions.
Neither the policy nor a renderer is needed.

Two methods (`Method`):

- ``exact``: all values must be equal, except for the rounding of contact impulses. This holds on the processor model
  of the result.
- ``checkpoints``: for other processors, whose rounding errors let heaps diverge. The simulation continues from each
  recorded checkpoint, and must be near the next one.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import hypergeom

from robocas_ms3.core.errors import EvaluationError, PolicyError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import FolderKind, OutputFolder, list_setting_changes
from robocas_ms3.evaluation.audit_checkpoints import (
    SECONDS_TOLERANCE,
    CheckpointEnv,
    list_differences_within_tolerance,
)
from robocas_ms3.evaluation.outcomes import Checkpoints, Count, Outcome
from robocas_ms3.evaluation.policy import CONVENTIONS, EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.protocol import LoadedProtocol, ProtocolEpisode
from robocas_ms3.evaluation.results import Result, describe_machine, get_package_versions
from robocas_ms3.evaluation.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

Method = Literal["exact", "checkpoints"]

OUTPUT = FolderKind("robocas eval audit", ("audit.json",), "result_hash")
_EPISODES = "episodes.jsonl"
_CONFIDENCE = 0.95
_IMPULSE_TOLERANCE = 1e-5  # relative; in 1 of 400 episodes a float32 sum of forces differed in its last bits
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
    """What an audit will do.

    Attributes:
        method: how episodes are compared.
        episodes: numbers of the episodes.
        seed: random seed by which they were chosen.
        replayed: number of these episodes that were replayed in an earlier run of the audit.
    """

    method: Method
    episodes: list[int]
    seed: int
    replayed: int


class StoredActionsPolicy:
    """Policy that sends the stored actions of a result. It observes nothing.

    An episode that needs more actions ends with an error.

    Args:
        result: the result.
        waits: whether an episode first gets actions without motion for `SECONDS_TOLERANCE`.
        on_start: is called with the number of each episode that starts.
    """

    def __init__(
        self, result: Result, *, waits: bool = False, on_start: Callable[[int], None] = lambda number: None
    ) -> None:
        self._result, self._waits, self._on_start, values = result, waits, on_start, result.run.policy.spec
        motion = {name: values[name] for name in ("convention", "reference", "rate_hz") if name in values}
        self.spec = PolicySpec(**motion, language="none")
        self._actions: dict[int, Iterator[NDArray[np.float32]]] = {}  # by env

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            actions = self._result.read_actions(episode.episode)
            if self._waits and len(actions):
                actions = np.concatenate([actions, self._make_waiting_actions(episode.episode, actions[-1])])
            self._actions[episode.env] = iter(actions)
            self._on_start(episode.episode)

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

    def _make_waiting_actions(self, number: int, last: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (W, A) that keep the pose, or the joint targets, and the gripper command of an action (A,)."""
        outcome, action = self._result.outcomes[number], last.copy()
        if CONVENTIONS[self.spec.convention].decode is not None:
            action[:-1] = 0
        steps_per_second = outcome.steps / max(outcome.seconds, 1e-9)
        return np.tile(action, (round(SECONDS_TOLERANCE * steps_per_second), 1))


def choose_method(result: Result) -> Method:
    """Return ``exact`` if the result was made on this model of processor, or on an unknown one."""
    machines = [part.machine for part in result.run.merged_from] or [result.run.machine]
    models = {(machine or {}).get("model", "") for machine in machines} - {"", describe_machine()["model"]}
    return "checkpoints" if models else "exact"


def find_audit_obstacle(result: Result, method: Method) -> str:
    """Return why the episodes of a result cannot be replayed with a method; empty if they can."""
    if result.run.backend != "processes":
        return f"its backend is {result.run.backend}, whose physics is not repeatable; expected processes"
    if not choose_episodes(result, None, 0):
        return "it has no episode that can be replayed"
    installed, recorded = get_package_versions(), result.run.versions
    if differing := [name for name in recorded if name in installed and installed[name] != recorded[name]]:
        names = ", ".join(f"{name} {recorded[name]}" for name in differing)
        return f"it was made with other versions: {names}. Install these versions"
    if method == "checkpoints":
        if result.run.weld:
            return "the method checkpoints is not available with the weld"
        if any(not len(result.read_checkpoints(number).steps) for number in choose_episodes(result, None, 0)):
            return "the method checkpoints needs checkpoints of all episodes"
    return ""


def choose_episodes(result: Result, sample: int | None, seed: int) -> list[int]:
    """Return the numbers of the episodes to replay, in ascending order.

    Episodes that ended with an error before their first action are left out.

    Args:
        result: the result.
        sample: number of episodes to choose at random; None: all.
        seed: random seed of the choice.
    """
    numbers = [number for number, outcome in result.outcomes.items() if outcome.steps or not outcome.error]
    if sample is None or sample >= len(numbers):
        return numbers
    return sorted(np.random.default_rng(seed).choice(numbers, sample, replace=False).tolist())


def run_audit(
    result: Result,
    protocol: LoadedProtocol,
    out: Path,
    *,
    method: Method,
    sample: int | None = None,
    seed: int | None = None,
    envs: int = 2,
    overwrite: bool = False,
    on_start: Callable[[AuditPlan], None] = lambda plan: None,
) -> Iterator[AuditedEpisode]:
    """Replay episodes of a result and yield each. An interrupted audit is continued.

    Args:
        result: the result, without violations (`verify`).
        protocol: its protocol.
        out: folder of the audit. It must not come from the author of the result.
        method: how episodes are compared.
        sample: number of episodes to replay, chosen at random; None: all (`choose_episodes`).
        seed: random seed of the choice; None: that of the audit in ``out``, or a number that nobody can predict.
        envs: number of environments that run at the same time; only for ``exact``.
        overwrite: whether to delete an earlier audit.
        on_start: is called before the first episode.

    Raises:
        OutputExistsError: ``out`` has an audit of another result, or with another method or other versions.
        EvaluationError: an episode could not be replayed, for example because its worker process crashed.
    """
    settings = {"result_hash": hash_result(result), "method": method, "versions": get_package_versions()}
    with OutputFolder(out, OUTPUT, settings, overwrite=overwrite) as output:
        earlier = None if overwrite or output.recorded is None else int(output.recorded["seed"])
        seed = seed if seed is not None else secrets.randbits(32) if earlier is None else earlier
        output.start({**settings, "seed": seed})
        file = JsonLinesFile[AuditedEpisode](output.path / _EPISODES, AuditedEpisode)
        replayed, chosen = {one.episode: one for one in file.read()}, choose_episodes(result, sample, seed)
        on_start(AuditPlan(method, chosen, seed, len(replayed.keys() & set(chosen))))
        yield from (replayed[number] for number in chosen if number in replayed)
        episodes = [protocol.episodes[number] for number in chosen if number not in replayed]
        for number, differences in _replay(result, protocol, episodes, method, envs) if episodes else ():
            file.append([AuditedEpisode(number, differences)])
            yield AuditedEpisode(number, differences)


def _replay(
    result: Result, protocol: LoadedProtocol, episodes: Sequence[ProtocolEpisode], method: Method, envs: int
) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the differences of each episode."""
    is_exact, run = method == "exact", result.run
    opened: list[CheckpointEnv] = []  # the last is in use

    def wrap(env: Any) -> Any:
        if is_exact:
            return env
        opened.append(CheckpointEnv(env))
        return opened[-1]

    def start(number: int) -> None:
        if not is_exact:
            opened[-1].start(result.read_checkpoints(number))

    settings = EvaluationSettings(
        tasks=tuple(run.played_as),
        policy="audit",
        protocol=str(protocol.folder),
        weld=run.weld,
        action_noise=run.action_noise or (0.0, 0.0),
        envs=envs if is_exact else 1,
        backend="processes",
    )
    policy = StoredActionsPolicy(result, waits=not is_exact, on_start=start)
    with closing(EvaluationSession(policy, settings, wrap)) as session:
        for replayed in session.run_episodes(episodes):
            number, error = replayed.outcome.episode, replayed.outcome.error
            if error not in ("", _NO_ACTIONS_LEFT):
                where, fix = f"episode {number}", "Run the same command again."
                raise EvaluationError("an episode could not be replayed", where=where, found=error, fix=fix)
            recorded = result.outcomes[number]
            if is_exact:
                differences = list_differences(recorded, replayed.outcome)
                differences = differences or list_state_differences(
                    result.read_checkpoints(number), replayed.checkpoints
                )
            else:
                differences = opened[-1].differences or list_differences_within_tolerance(recorded, replayed.outcome)
            yield number, differences


def list_differences(recorded: Outcome, replayed: Outcome) -> list[str]:
    """Return a text per value of a recorded outcome that differs from that of the stored actions."""
    before, now = recorded.reproducible_values(), replayed.reproducible_values()
    impulse, impulse_now = (of["measures"].get("contact_impulse", 0.0) for of in (before, now))
    if abs(impulse - impulse_now) <= _IMPULSE_TOLERANCE * max(impulse, impulse_now):
        before["measures"]["contact_impulse"] = impulse_now
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


def bound_differing_episodes(sample: int, total: int) -> int:
    """Return the greatest number of differing episodes that a sample without differences does not exclude.

    With at least one more among the ``total`` episodes, a random sample would show one with a probability of at least
    95 %.
    """
    differing = np.arange(total - sample + 1)
    unseen = hypergeom.pmf(0, total, differing, sample)  # probability that the sample has none of them
    return int(differing[unseen > 1 - _CONFIDENCE].max())
