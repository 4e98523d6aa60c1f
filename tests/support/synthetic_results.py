"""Synthetic results, without a simulator."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol, ProtocolEpisode
from robocas_ms3.evaluation.results.outcomes import (
    Checkpoints,
    Outcome,
    Retrieval,
    compute_order_score,
    find_failure_stage,
)
from robocas_ms3.evaluation.results.result_files import OUTCOMES, RUN, Result, read_result
from robocas_ms3.evaluation.results.stored_episodes import hash_actions, write_actions, write_checkpoints

STAGES = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_lifted", "target_in_basket")
RUN_OF = {
    "protocol": "made_up",
    "protocol_hash": "ab" * 32,
    "policy": {"name": "mine", "class": "mine:Policy", "spec": {"rate_hz": 20}},
    "weld": False,
    "backend": "processes",
    "versions": {"robocas_ms3": "0.1.0", "torch": "2.4"},
    "pack_hashes": {"builtin": "cd" * 32},
    "machine": {"processor": "x86_64", "python": "3.11"},
}


def outcome(episode: int, came_to: int = 7, **others: Any) -> Outcome:
    """Return the outcome of a pick episode that reached `came_to` of seven stages, each 10 steps of 0.05 s apart."""
    names = (*STAGES, "success")
    flags = {name: 10 * (at + 1) if at < came_to else None for at, name in enumerate(names)} | {"fail": None}
    success = flags["success"] is not None
    flags["success_v0"] = flags["success"]
    made = Outcome(
        episode=episode,
        task="pick",
        config="table",
        seed=100 + episode,
        split="test",
        success=success,
        success_at_end=success,
        success_v0=success,
        steps=70 if success else 800,
        seconds=3.5 if success else 40.0,
        failure_stage=find_failure_stage(flags),
        flags=flags,
        flag_seconds={name: None if step is None else step / 20 for name, step in flags.items()},
        measures={"path_length": 1.5, "contact_impulse": 2.0, "disturbed_most": 1.0, "fallen": 0.0},
        inference_ms=0.5,
    )
    made = replace(made, **others)
    return made if "actions_hash" in others else replace(made, actions_hash=hash_actions(actions_of(made)))


def actions_of(made: Outcome) -> NDArray[np.float32]:
    """Return the actions (T, 7) of an outcome: zeros, but the number of the episode in the first column."""
    actions = np.zeros((made.steps, 7), np.float32)
    actions[:, 0] = made.episode
    return actions


def write(folder: Path, outcomes: Iterable[Outcome], **run: Any) -> Result:
    """Write a result with these outcomes and their actions; other arguments replace values of ``run.json``."""
    folder.mkdir(parents=True)
    outcomes = list(outcomes)
    for one in outcomes:
        write_actions(folder, one.episode, actions_of(one))
    (folder / RUN).write_text(json.dumps({**RUN_OF, **run}))
    (folder / OUTCOMES).write_text("".join(json.dumps(asdict(one)) + "\n" for one in outcomes))
    return read_result(folder)


def of_protocol(folder: Path, protocol: LoadedProtocol, failed: Collection[int] = (), **run: Any) -> Result:
    """Write a valid result with actions and checkpoints of all episodes of a protocol.

    All episodes succeeded, except those with numbers in ``failed``, which ended with the flag ``fail`` after two
    stages. Other arguments replace values of ``run.json``.
    """
    outcomes = [_outcome_of_protocol(one, protocol, has_failed=one.episode in failed) for one in protocol.episodes]
    packs = {protocol.rules.pack: protocol.rules.pack_hash}
    settings = {"protocol": protocol.rules.name, "protocol_hash": protocol.hash, "pack_hashes": packs}
    result = write(folder, outcomes, **settings, **run)
    for made in outcomes:
        steps, states = np.array([made.steps], np.int32), np.full((1, 1), made.episode, np.float32)
        write_checkpoints(folder, made.episode, Checkpoints(steps, states))
    return result


def _outcome_of_protocol(one: ProtocolEpisode, protocol: LoadedProtocol, *, has_failed: bool) -> Outcome:
    more: dict[str, tuple[str, ...]] = {
        "search": ("obstacles_cleared", "cleared_at_reset"),
        "open_pick": ("furniture_opened",),
    }
    values = {"task": one.task, "config": one.config, "seed": one.seed, "split": one.split, "p_vis": one.p_vis}
    if has_failed:
        values |= {"steps": 30, "seconds": 1.5}
    made = outcome(one.episode, 2 if has_failed else 7, **values)
    never = dict.fromkeys(more.get(one.task, ()))
    flags, seconds = made.flags | never, made.flag_seconds | never
    if has_failed:
        flags["fail"], seconds["fail"] = made.steps, made.seconds
    elif (v0_steps := protocol.rules.max_v0_steps) is not None:  # success by RoboCAS-v0's rule ends the episode
        flags["success_v0"] = made.steps - v0_steps + 1
        seconds["success_v0"] = flags["success_v0"] / 20
    retrieval = None
    if one.task == "search":
        retrieval = Retrieval([], [], 0, compute_order_score([], 0, flags["target_grasped"]))
    stage = find_failure_stage(flags)
    return replace(made, flags=flags, flag_seconds=seconds, retrieval=retrieval, failure_stage=stage)
