"""Evaluate a policy by a protocol: every episode of its list once, in as many envs as there is room for."""

from __future__ import annotations

import logging
import platform
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.assets.pack import MANIFEST, load_pack, sha256
from robocas_ms3.core.errors import EvaluationError, WorkerDied
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.core.outputs import while_there
from robocas_ms3.core.strict import nearest
from robocas_ms3.core.workers import NO_LIMITS, Limits
from robocas_ms3.datasets.writing.render import require_renderer
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.policy import Policy, describe
from robocas_ms3.evaluation.protocol import Episode, LoadedProtocol
from robocas_ms3.evaluation.rollout import Rollout, Rollouts, Rules
from robocas_ms3.evaluation.stage import make_env, object_ids, rate_of, start_of
from robocas_ms3.evaluation.weld import refuse
from robocas_ms3.tasks.vector.backend import Backend, choose_backend

TRIES = 2
"""How often an episode is begun whose process died, counting the first time."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Settings:
    """How an evaluation runs; nothing of it but ``weld`` changes what comes out.

    Attributes:
        num_envs: envs at a time.
        backend: where they run, see `make_vec`.
        workers: processes.
        shard: (number, of how many): only these episodes, every n-th.
        tasks: only these; empty: all of the protocol's.
        episodes: only the first so many of each configuration.
        split: only the episodes of this split; empty: of all.
        weld: whether what is lifted is welded to the hand, as upstream does (`weld`).
        limits: of what a process of envs may take for a step or a reset. An episode that goes beyond them, or takes its
            process down, is played again once; then it is broken off, which is a failure.
    """

    num_envs: int = 2
    backend: Backend = "auto"
    workers: int | None = None
    shard: tuple[int, int] = (0, 1)
    tasks: tuple[str, ...] = ()
    episodes: int | None = None
    split: str = ""
    weld: bool = False
    limits: Limits = NO_LIMITS


def evaluate(
    protocol: LoadedProtocol,
    policy: Policy,
    name: str,
    folder: Path,
    settings: Settings,
    *,
    resume: bool = False,
    again: bool = False,
    on_start: Callable[[int], None] = lambda count: None,
) -> Iterator[Outcome]:
    """Play the episodes that a result lacks, and write each as it ends.

    Args:
        protocol: what is measured.
        policy: of whom.
        name: that the policy was asked for by.
        folder: of the result.
        settings: how.
        resume: whether to go on with a result that is there.
        again: whether to play episodes again that an error broke off.
        on_start: called with how many episodes are to be played.

    Yields:
        What came of an episode.

    Raises:
        DatasetError: the policy wants to see, and there is no render device.
        EvaluationError: the policy or the weld does not fit the protocol, the pack is another, or the result is of
            another run.
        RobocasError: another process writes there.
    """
    protocol.rules.refuse(policy.spec)
    rate_of(protocol, policy.spec)
    if settings.weld:
        refuse(protocol.rules.stepping, choose_backend(settings.backend))
    wanted = chosen(protocol.episodes, settings)
    if not wanted:
        number, of = settings.shard
        raise EvaluationError("no episodes in this part", where=protocol.rules.name, found=f"shard {number}/{of}")
    if policy.spec.cameras:
        require_renderer()
    with locked_folder(folder):
        done = results.begin(folder, about(protocol, policy, name, settings), resume=resume, again=again)
        left = [episode for episode in wanted if episode.episode not in done]
        on_start(len(left))
        for config in dict.fromkeys(episode.config for episode in left):
            of_config = [episode for episode in left if episode.config == config]
            for outcome in _play(protocol, policy, of_config, settings):
                with while_there(folder / results.RUN, EvaluationError):
                    results.append(folder, outcome)
                yield outcome


def chosen(episodes: Sequence[Episode], settings: Settings) -> list[Episode]:
    """The episodes of a run.

    Raises:
        EvaluationError: there are none of these tasks, or of this split.
    """
    for what, wanted in (("task", settings.tasks), ("split", (settings.split,) if settings.split else ())):
        known = dict.fromkeys(str(getattr(episode, what)) for episode in episodes)
        for name in wanted:
            if name not in known:
                other = "Name a protocol that has it, or make one: robocas eval freeze."
                expected, fix = ", ".join(known), nearest(name, known) or other
                raise EvaluationError(f"the protocol has no such {what}", expected=expected, found=name, fix=fix)
    number, of = settings.shard
    taken: dict[str, int] = {}
    found = []
    for episode in episodes:
        if settings.tasks and episode.task not in settings.tasks:
            continue
        if settings.split not in ("", episode.split):
            continue
        taken[episode.config] = taken.get(episode.config, 0) + 1
        if settings.episodes is not None and taken[episode.config] > settings.episodes:
            continue
        if episode.episode % of == number:
            found.append(episode)
    return found


def about(protocol: LoadedProtocol, policy: Policy, name: str, settings: Settings) -> dict[str, Any]:
    """What a result says of what it was measured with.

    Raises:
        EvaluationError: the pack is not the protocol's.
    """
    pack = sha256(load_pack(protocol.rules.pack).root / MANIFEST)
    if pack != protocol.rules.pack_hash:
        raise EvaluationError(
            "the object pack is another", where=protocol.rules.name, expected=protocol.rules.pack_hash, found=pack
        )
    return {
        "protocol": protocol.rules.name,
        "protocol_hash": protocol.hash,
        "policy": {"name": name} | describe(policy) | {"name": name},  # a description may not rename it
        "weld": settings.weld,
        "backend": choose_backend(settings.backend),
        "versions": results.versions(),
        "pack_hashes": {protocol.rules.pack: pack},
        "machine": {"processor": platform.machine(), "python": platform.python_version()},
    }


def _play(protocol: LoadedProtocol, policy: Policy, episodes: list[Episode], settings: Settings) -> Iterator[Outcome]:
    rules, first = protocol.rules, episodes[0]
    rate, gpu = rate_of(protocol, policy.spec), choose_backend(settings.backend) == "gpu"
    count = min(settings.num_envs, len(episodes))
    runs = {name: getattr(settings, name) for name in ("backend", "workers", "weld", "limits")}
    steps = rules.steps(first.task, rate)
    assert steps is not None  # `load_protocol` saw to it
    ends = Rules(steps, tuple(rules.ends_on), rules.max_v0_steps)
    left = {one.episode: one for one in episodes}
    died: Counter[int] = Counter()  # by episode, how often its process did

    def came_of(played: Rollout) -> Outcome:
        one = left.pop(played.start.episode)
        return Outcome.of(played, one, object_ids(protocol, one))

    while left:
        env = make_env(protocol, policy.spec, first, min(count, len(left)), **runs)
        rollouts = Rollouts(env, policy, ends, 1 / rate, refill=not gpu)
        try:
            yield from map(came_of, rollouts.play([start_of(protocol, one) for one in left.values()]))
        except WorkerDied as error:
            lost = list(rollouts.lost(error.envs, f"its process died: {error.found}"))
            if not lost:
                raise
            for played in lost:
                number = played.start.episode
                died[number] += 1
                if died[number] < TRIES:
                    _log.warning("episode %d: %s; it is played again", number, played.error)
                else:
                    yield came_of(played)
        finally:
            env.close()
