"""Settings of an evaluation, and the episodes that they choose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.strict import nearest
from robocas_ms3.core.workers import NO_LIMITS, Limits
from robocas_ms3.evaluation.protocol import Episode, LoadedProtocol
from robocas_ms3.tasks.vector.backend import Backend


@dataclass(frozen=True)
class EvaluationSettings:
    """How an evaluation runs. Only ``weld`` changes the outcome of an episode.

    Attributes:
        policy_name: name of the policy in the result, as the user gave it.
        num_envs: number of envs.
        backend: where they run, see `make_vec`.
        workers: number of processes; None: see `make_vec`.
        limits: time and memory of a process for one step or reset. An episode that exceeds them, or whose process dies,
            is started again once; then it counts as failed.
        shard: (index, count): only the episodes whose number modulo ``count`` is ``index``.
        tasks: only these tasks; empty: all of the protocol.
        episodes: only the first so many of each configuration.
        split: only the episodes of this split; empty: all.
        weld: whether lifted objects are welded to the hand, as RoboCAS-v0 does (`weld`).
        render_size: (width, height) of the images of the env's ``render``, pixels; None: it renders none.
    """

    policy_name: str = ""
    num_envs: int = 2
    backend: Backend = "auto"
    workers: int | None = None
    limits: Limits = NO_LIMITS
    shard: tuple[int, int] = (0, 1)
    tasks: tuple[str, ...] = ()
    episodes: int | None = None
    split: str = ""
    weld: bool = False
    render_size: tuple[int, int] | None = None


def choose_episodes(protocol: LoadedProtocol, settings: EvaluationSettings) -> list[Episode]:
    """Return the episodes of a protocol that the settings choose, at least one.

    Raises:
        EvaluationError: the protocol has no such task or split, or no episode is left.
    """
    for what, names in (("task", settings.tasks), ("split", (settings.split,) if settings.split else ())):
        known = dict.fromkeys(str(getattr(episode, what)) for episode in protocol.episodes)
        for name in names:
            if name not in known:
                other = "Name a protocol that has it, or make one: robocas eval freeze."
                expected, fix = ", ".join(known), nearest(name, known) or other
                raise EvaluationError(f"the protocol has no such {what}", expected=expected, found=name, fix=fix)
    index, count = settings.shard
    of_config: Counter[str] = Counter()
    chosen = []
    for episode in protocol.episodes:
        if (settings.tasks and episode.task not in settings.tasks) or settings.split not in ("", episode.split):
            continue
        of_config[episode.config] += 1
        if settings.episodes is not None and of_config[episode.config] > settings.episodes:
            continue
        if episode.episode % count == index:
            chosen.append(episode)
    if not chosen:
        raise EvaluationError("no episodes in this shard", where=protocol.rules.name, found=f"{index}/{count}")
    return chosen


def check_one_configuration(protocol: LoadedProtocol, episodes: Sequence[Episode], fix: str = "") -> None:
    """Check that episodes can run in one batch.

    Raises:
        EvaluationError: their configurations differ.
    """
    configs = list(dict.fromkeys(episode.config for episode in episodes))
    if len(configs) > 1:
        where, found = protocol.rules.name, ", ".join(configs)
        raise EvaluationError(
            "episodes of several configurations in one batch", where=where, expected="one", found=found, fix=fix
        )
