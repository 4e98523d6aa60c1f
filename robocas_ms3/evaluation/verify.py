"""Whether a result can be believed as far as its files tell."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from robocas_ms3.core.words import count_of
from robocas_ms3.evaluation.outcomes import Outcome, failure_stage
from robocas_ms3.evaluation.protocol import DEFAULT_HZ, LoadedProtocol
from robocas_ms3.evaluation.results import Result, RunRecord
from robocas_ms3.scenes.task_specs import TASKS


def problems(result: Result, protocol: LoadedProtocol) -> list[str]:
    """What is wrong with a result; empty: nothing that its files could tell.

    Args:
        result: that was read.
        protocol: that it says it is of.
    """
    found = []
    if result.run.protocol_hash != protocol.hash:
        found.append(f"it is of another protocol than {protocol.folder}: {result.run.protocol_hash}")
    pack = result.run.pack_hashes.get(protocol.rules.pack)
    if pack != protocol.rules.pack_hash:
        found.append(f"it was measured with another pack: {pack}")
    found += _of_weld(result, protocol)
    for number, outcome in result.outcomes.items():
        if not 0 <= number < len(protocol.episodes):
            found.append(f"episode {number}: the protocol has none of this number")
            continue
        episode = protocol.episodes[number]
        for name in ("task", "config", "seed", "split", "p_vis"):
            if getattr(outcome, name) != getattr(episode, name):
                found.append(f"episode {number}: {name} is {getattr(outcome, name)}, not {getattr(episode, name)}")
        order = TASKS[episode.task].stages
        said = [*_too_long(outcome, protocol, result.run), *_at_odds(outcome, protocol, order)]
        found += [f"episode {number}: {problem}" for problem in said]
    missing = len(set(range(len(protocol.episodes))) - result.outcomes.keys())
    if missing:
        found.append(f"missing: {missing} of {count_of(len(protocol.episodes), 'episode')}")
    return found


def _of_weld(result: Result, protocol: LoadedProtocol) -> Iterator[str]:
    weld = result.run.weld
    if weld and protocol.rules.stepping != "upstream":
        yield "it was measured with upstream's weld, which does not belong to this protocol's steps"
    for number, outcome in result.outcomes.items():
        if ("welds" in outcome.measures) != weld:
            yield f"episode {number}: it {'counts no welds' if weld else 'counts welds'}, the run says weld: {weld}"


def _too_long(outcome: Outcome, protocol: LoadedProtocol, run: RunRecord) -> Iterator[str]:
    rules = protocol.rules
    rate = rules.rate_hz or run.policy.wants.get("rate_hz") or DEFAULT_HZ
    limit = rules.steps(outcome.task, rate)
    if limit is not None and outcome.steps > limit:
        yield f"{count_of(outcome.steps, 'step')}, {limit} allowed"
    if rules.stepping == "timed":
        expected = outcome.steps / rate
        if abs(outcome.seconds - expected) > 1e-3:
            yield f"{outcome.seconds:g} s, its {count_of(outcome.steps, 'step')} should take {expected:g}"


def _of_retrieval(outcome: Outcome) -> Iterator[str]:
    """What is said of its order against itself; that of a policy that failed at once was not looked at."""
    order = outcome.retrieval
    if order is None:
        return
    try:
        late = [move["object"] for move in order["moved"] if not 0 < move["step"] <= outcome.steps]
        right = sum(move["needed"] and move["in_order"] for move in order["moved"])
        held, of = outcome.flags.get("target_grasped"), len(order["moved"]) + order["left"]
        score = None if held is None else 1.0 if of == 0 else round(right / of, 4)
        if "obstacles_cleared" not in outcome.flags or late or order["left"] < 0 or order["score"] != score:
            yield "its order of retrieval does not agree with itself"
    except (TypeError, KeyError, ZeroDivisionError):
        yield "its order of retrieval is none"


def _of_seconds(outcome: Outcome) -> Iterator[str]:
    flags, seconds = outcome.flags, outcome.flag_seconds
    if flags.keys() != seconds.keys() or any((flags[name] is None) != (seconds[name] is None) for name in flags):
        yield "flag_seconds are not of its flags"
    late = [name for name, second in seconds.items() if second is not None and not 0 <= second <= outcome.seconds]
    if late:
        yield f"{', '.join(late)} held first after its {outcome.seconds:g} s"


def _at_odds(outcome: Outcome, protocol: LoadedProtocol, order: Sequence[str]) -> Iterator[str]:
    """What an outcome says against itself; order: of its task's stages."""
    flags = outcome.flags
    yield from _of_retrieval(outcome)
    if outcome.success != (flags.get("success") is not None):
        yield "success does not agree with its flags"
    if outcome.success_at_end and not outcome.success:
        yield "success_at_end, but no success"
    if outcome.success_v0 and flags.get("success_v0") is None:
        yield "success_v0 does not agree with its flags"
    if any(not 0 <= value < math.inf for value in (outcome.seconds, outcome.inference_ms, *outcome.measures.values())):
        yield "a measure is no number from 0 on"
    yield from _of_seconds(outcome)
    stage = failure_stage(flags, outcome.error, order)
    if outcome.failure_stage != stage:
        yield f"failure_stage is {outcome.failure_stage or 'none'}, by its flags {stage or 'none'}"
    late = [name for name, step in flags.items() if step is not None and step > outcome.steps]
    if late:
        yield f"{', '.join(late)} held first after its {count_of(outcome.steps, 'step')}"
    for name in protocol.rules.ends_on:
        step = flags.get(name)
        if step is not None and 0 < step < outcome.steps:  # what held before the first step ended nothing
            yield f"it went on after {name}, {step} of {count_of(outcome.steps, 'step')}"
