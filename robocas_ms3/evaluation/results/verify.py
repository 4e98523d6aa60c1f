"""Checks that a result fits its protocol and that its values are consistent."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator
from typing import Any

from pydantic import TypeAdapter, ValidationError

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.strict_model import validate_json
from robocas_ms3.core.text import format_count
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.protocols.protocol import DEFAULT_HZ, LoadedProtocol, Protocol, ProtocolEpisode
from robocas_ms3.evaluation.results.outcomes import MEASURES, Outcome, compute_order_score, find_failure_stage
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.results.run_record import RunRecord
from robocas_ms3.scenes.task_specs import TASKS

# Flags of the built-in tasks, whose configurations always have a basket. Custom tasks may have other stages.
_FLAGS = (
    "reached_any",
    "picked_any",
    "reached_target",
    "target_grasped",
    "target_lifted",
    "target_in_basket",
    "success",
    "fail",
    "success_v0",
)
_FLAGS_OF_TASK = {"search": ("obstacles_cleared", "cleared_at_reset"), "open_pick": ("furniture_opened",)}
# Pairs (a, b) of flags of the built-in tasks: if b held, a held at the same step or before, by their
# definitions in `tasks.success`.
_IMPLIED = (
    ("reached_any", "reached_target"),
    ("reached_any", "picked_any"),
    ("reached_target", "target_grasped"),
    ("target_grasped", "target_lifted"),
    ("picked_any", "target_lifted"),
    ("target_lifted", "success"),
    ("target_in_basket", "success"),
)
_TIME_TOLERANCE = 1e-3  # s
_HASH = re.compile("[0-9a-f]{64}")
_SPEC = TypeAdapter(PolicySpec)


def find_violations(
    result: Result, protocol: LoadedProtocol, *, is_complete: bool = True, stored: Collection[int] | None = None
) -> list[str]:
    """Return one text per violation in a result; empty if the result fits the protocol and is consistent.

    Args:
        result: the result.
        protocol: its protocol.
        is_complete: whether the result must have all episodes of the protocol.
        stored: numbers of the episodes whose actions must be stored; None: all. The others need the hash only.

    Violations are another hash, missing or unknown episodes, values that contradict the protocol or other values,
    missing stored actions, and stored actions or checkpoints that do not fit their episode. Checkpoints may be missing.
    """
    run, rules, count = result.run, protocol.rules, len(protocol.episodes)
    found = []
    if run.protocol_hash != protocol.hash:
        found.append(f"protocol hash {run.protocol_hash}, expected {protocol.hash} of {protocol.folder}")
    pack = run.pack_hashes.get(rules.pack)
    if pack != rules.pack_hash:
        found.append(f"hash of pack {rules.pack}: {pack}, expected {rules.pack_hash}")
    if run.weld and rules.stepping != "upstream":
        found.append("weld: true, but the weld needs a protocol with RoboCAS-v0's steps")
    if run.played_as != protocol.find_task_aliases(list(run.played_as)):
        found.append(f"played_as is {run.played_as}, but this protocol allows no such alias")
    if problems := _find_spec_violations(run.policy.spec):  # the checks of the episodes need its rate
        return found + problems
    for number, outcome in result.outcomes.items():
        if number < count:
            of_episode = [*_find_outcome_violations(outcome, protocol.episodes[number], protocol, run)]
            if stored is None or number in stored:
                of_episode += _find_action_violations(result, number)
            elif not _HASH.fullmatch(outcome.actions_hash):
                of_episode.append(f"actions_hash is {outcome.actions_hash or 'empty'}, expected a SHA-256")
        else:
            of_episode = ["this episode is not in the protocol"]
        found += [f"episode {number}: {problem}" for problem in of_episode]
    missing = len(set(range(count)) - result.outcomes.keys())
    if is_complete and missing:
        found.append(f"{missing} of {format_count(count, 'episode')} missing")
    return found


def check_consistency(result: Result, protocol: LoadedProtocol, *, stored: Collection[int] | None = None) -> None:
    """Raise EvaluationError if a result, which may lack episodes, has violations (`find_violations`)."""
    if violations := find_violations(result, protocol, is_complete=False, stored=stored):
        what, fix = "the result has violations", "Run robocas eval verify to list all."
        found = f"{format_count(len(violations), 'violation')}, the first: {violations[0]}"
        raise EvaluationError(what, where=result.folder, found=found, fix=fix)


def _find_spec_violations(spec: dict[str, Any]) -> list[str]:
    try:
        validate_json(_SPEC, json.dumps(spec))
    except ValidationError as error:
        problems = [(".".join(map(str, one["loc"])), one["input"], one["msg"]) for one in error.errors()]
        return [f"policy.spec.{key} is {str(value)[:80]}: {message}" for key, value, message in problems]
    except EvaluationError as error:  # of `PolicySpec` itself
        return [f"policy.spec.{error}"]
    return []


def _find_outcome_violations(
    outcome: Outcome, episode: ProtocolEpisode, protocol: LoadedProtocol, run: RunRecord
) -> Iterator[str]:
    rules, flags = protocol.rules, outcome.flags
    task = next((task for task, other in run.played_as.items() if other == episode.task), episode.task)
    expected = {name: getattr(episode, name) for name in ("config", "seed", "split", "p_vis")}
    for name, value in {"task": task, **expected}.items():
        if getattr(outcome, name) != value:
            yield f"{name} is {getattr(outcome, name)}, expected {value}"
    if not outcome.error and ("welds" in outcome.measures) != run.weld:
        yield f"{'missing' if run.weld else 'unexpected'} value measures.welds: the run has weld: {run.weld}"
    if missing := [name for name in MEASURES if name not in outcome.measures]:
        yield f"measures: missing {', '.join(missing)}"
    is_builtin = episode.task in TASKS.builtin
    expected_flags = (*_FLAGS, *_FLAGS_OF_TASK.get(episode.task, ())) if is_builtin else ("success", "fail")
    if not outcome.error and (missing := [name for name in expected_flags if name not in flags]):
        yield f"flags: missing {', '.join(missing)}"
    rate = rules.rate_hz or run.policy.spec.get("rate_hz") or DEFAULT_HZ
    yield from _find_length_violations(outcome, rules, rules.step_limit(episode.task, rate))
    if rules.stepping == "timed":
        yield from _find_rate_violations(outcome, rate)
    if not outcome.error and outcome.success != (flags.get("success") is not None):
        yield f"success is {outcome.success}, but flags.success is {flags.get('success')}"
    if outcome.success_at_end and not outcome.success:
        yield "success_at_end is True, but success is False"
    if outcome.success_v0 and flags.get("success_v0") is None:
        yield "success_v0 is True, but flags.success_v0 is None"
    stage = find_failure_stage(flags, outcome.error, TASKS[episode.task].stages)
    if outcome.failure_stage != stage:
        yield f"failure_stage is {outcome.failure_stage or 'empty'}, expected {stage or 'empty'} from the flags"
    late = [name for name, step in flags.items() if step is not None and step > outcome.steps]
    if late:
        yield f"flags: {', '.join(late)} first held after the last step, expected at most {outcome.steps}"
    for before, after in _IMPLIED if is_builtin else ():
        at, later = flags.get(before), flags.get(after)
        if later is not None and (at is None or at > later):
            yield f"flags: {after} held at step {later}, expected {before} at the same step or before, found {at}"
    yield from _find_time_violations(outcome)
    yield from _find_retrieval_violations(outcome, is_required=episode.task == "search" and not outcome.error)


def _find_length_violations(outcome: Outcome, rules: Protocol, limit: int | None) -> Iterator[str]:
    """Yield how the number of steps contradicts the end conditions; ``limit``: maximum number of steps."""
    flags, steps = outcome.flags, format_count(outcome.steps, "step")
    if not outcome.error and not outcome.steps:
        yield f"{steps}, expected at least 1 without an error"
    if limit is not None and outcome.steps > limit:
        yield f"{steps}, expected at most {limit} by the rules of the protocol"
    for name in rules.ends_on:
        step = flags.get(name)
        if step is not None and 0 < step < outcome.steps:  # a flag that holds at the reset ends no episode
            yield f"{name} held at step {step}, where the protocol ends the episode, but the episode has {steps}"
    if outcome.error or limit is None or outcome.steps >= limit:
        return
    at_v0, count = flags.get("success_v0"), rules.max_v0_steps
    may_end_by_v0 = count is not None and at_v0 is not None and outcome.steps >= at_v0 + count - 1
    if not may_end_by_v0 and not any(flags.get(name) is not None for name in rules.ends_on):
        yield f"{steps}, but nothing ended the episode before step {limit}"


def _find_rate_violations(outcome: Outcome, rate: float) -> Iterator[str]:
    """Yield times that are not those of their steps at a rate in Hz."""
    times = {"seconds": (outcome.steps, outcome.seconds)}
    for name, second in outcome.flag_seconds.items():
        step = outcome.flags.get(name)
        if step is not None and second is not None:
            times[f"flag_seconds.{name}"] = step, second
    for name, (step, second) in times.items():
        if abs(second - step / rate) > _TIME_TOLERANCE:
            yield f"{name} is {second:g}, expected {step / rate:g} for {format_count(step, 'step')} at {rate:g} Hz"


def _find_action_violations(result: Result, number: int) -> list[str]:
    try:
        result.read_actions(number)
        result.read_checkpoints(number)
    except EvaluationError as error:
        return [str(error)]
    return []


def _find_time_violations(outcome: Outcome) -> Iterator[str]:
    flags, seconds = outcome.flags, outcome.flag_seconds
    if flags.keys() != seconds.keys() or any((flags[name] is None) != (seconds[name] is None) for name in flags):
        yield "flag_seconds and flags have different keys or values"
    late = [name for name, second in seconds.items() if second is not None and second > outcome.seconds]
    if late:
        yield f"flag_seconds: {', '.join(late)} first held after the end of the episode at {outcome.seconds:g} s"


def _find_retrieval_violations(outcome: Outcome, *, is_required: bool) -> Iterator[str]:
    order = outcome.retrieval
    if order is None:
        if is_required:
            yield "retrieval: missing; expected in search"
        return
    if "obstacles_cleared" not in outcome.flags:
        yield "retrieval: unexpected; expected only in tasks with the stage obstacles_cleared"
    for move in order.moved:
        if not 0 < move.step <= outcome.steps:
            yield f"retrieval: an object moved at step {move.step}, expected 1 to {outcome.steps}"
    score = compute_order_score(order.moved, order.left, outcome.flags.get("target_grasped"))
    if order.score != score:
        yield f"retrieval: the score is {order.score}, expected {score} from the moved objects"
