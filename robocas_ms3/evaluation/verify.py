"""Check a result against its protocol and itself, as far as its files show."""

from __future__ import annotations

from collections.abc import Iterator

from robocas_ms3.core.text import format_count
from robocas_ms3.evaluation.outcomes import Outcome, failure_stage, retrieval_score
from robocas_ms3.evaluation.protocol import DEFAULT_HZ, LoadedProtocol, ProtocolEpisode
from robocas_ms3.evaluation.results import Result, RunRecord
from robocas_ms3.scenes.task_specs import TASKS


def find_violations(result: Result, protocol: LoadedProtocol) -> list[str]:
    """Return what is wrong with a result of a protocol; empty: nothing that its files show."""
    run, rules, count = result.run, protocol.rules, len(protocol.episodes)
    found = []
    if run.protocol_hash != protocol.hash:
        found.append(f"it is of another protocol than {protocol.folder}: {run.protocol_hash}")
    pack = run.pack_hashes.get(rules.pack)
    if pack != rules.pack_hash:
        found.append(f"it was measured with another pack: {pack}")
    if run.weld and rules.stepping != "upstream":
        found.append("it was measured with upstream's weld, which does not belong to this protocol's steps")
    for number, outcome in result.outcomes.items():
        if number < count:
            of_episode = _problems(outcome, protocol.episodes[number], protocol, run)
        else:
            of_episode = ["the protocol has none of this number"]
        found += [f"episode {number}: {problem}" for problem in of_episode]
    missing = len(set(range(count)) - result.outcomes.keys())
    if missing:
        found.append(f"missing: {missing} of {format_count(count, 'episode')}")
    return found


def _problems(outcome: Outcome, episode: ProtocolEpisode, protocol: LoadedProtocol, run: RunRecord) -> Iterator[str]:
    rules, flags, steps = protocol.rules, outcome.flags, format_count(outcome.steps, "step")
    for name in ("task", "config", "seed", "split", "p_vis"):
        if getattr(outcome, name) != getattr(episode, name):
            yield f"{name} is {getattr(outcome, name)}, not {getattr(episode, name)}"
    if ("welds" in outcome.measures) != run.weld:
        yield f"it {'counts no welds' if run.weld else 'counts welds'}, the run says weld: {run.weld}"
    rate = rules.rate_hz or run.policy.spec.get("rate_hz") or DEFAULT_HZ
    limit = rules.step_limit(outcome.task, rate)
    if limit is not None and outcome.steps > limit:
        yield f"{steps}, {limit} allowed"
    if rules.stepping == "timed" and abs(outcome.seconds - outcome.steps / rate) > 1e-3:
        yield f"{outcome.seconds:g} s, its {steps} should take {outcome.steps / rate:g}"
    if outcome.success != (flags.get("success") is not None):
        yield "success does not agree with its flags"
    if outcome.success_at_end and not outcome.success:
        yield "success_at_end, but no success"
    if outcome.success_v0 and flags.get("success_v0") is None:
        yield "success_v0 does not agree with its flags"
    stage = failure_stage(flags, outcome.error, TASKS[episode.task].stages)
    if outcome.failure_stage != stage:
        yield f"failure_stage is {outcome.failure_stage or 'none'}, by its flags {stage or 'none'}"
    late = [name for name, step in flags.items() if step is not None and step > outcome.steps]
    if late:
        yield f"{', '.join(late)} held first after its {steps}"
    for name in rules.ends_on:
        step = flags.get(name)
        if step is not None and 0 < step < outcome.steps:  # what held before the first step ended nothing
            yield f"it went on after {name}, {step} of {steps}"
    yield from _problems_of_seconds(outcome)
    yield from _problems_of_retrieval(outcome)


def _problems_of_seconds(outcome: Outcome) -> Iterator[str]:
    flags, seconds = outcome.flags, outcome.flag_seconds
    if flags.keys() != seconds.keys() or any((flags[name] is None) != (seconds[name] is None) for name in flags):
        yield "flag_seconds are not of its flags"
    late = [name for name, second in seconds.items() if second is not None and second > outcome.seconds]
    if late:
        yield f"{', '.join(late)} held first after its {outcome.seconds:g} s"


def _problems_of_retrieval(outcome: Outcome) -> Iterator[str]:
    order = outcome.retrieval
    if order is None:
        return
    late = [move for move in order.moved if not 0 < move.step <= outcome.steps]
    score = retrieval_score(order.moved, order.left, outcome.flags.get("target_grasped"))
    if "obstacles_cleared" not in outcome.flags or late or order.score != score:
        yield "its order of retrieval does not agree with itself"
