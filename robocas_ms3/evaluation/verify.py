"""Whether a result can be believed as far as its files tell."""

from __future__ import annotations

from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.results import Result


def problems(result: Result, protocol: LoadedProtocol) -> list[str]:
    """What is wrong with a result; empty: nothing that its files could tell.

    Args:
        result: that was read.
        protocol: that it says it is of.
    """
    found = []
    if result.run.get("protocol_hash") != protocol.hash:
        found.append(f"it is of another protocol than {protocol.folder}: {result.run.get('protocol_hash')}")
    pack = result.run.get("pack_hashes", {}).get(protocol.rules.pack)
    if pack != protocol.rules.pack_hash:
        found.append(f"it was measured with another pack: {pack}")
    for number, outcome in result.outcomes.items():
        if number >= len(protocol.episodes):
            found.append(f"episode {number}: the protocol has none of this number")
            continue
        episode = protocol.episodes[number]
        for name in ("task", "config", "seed", "split"):
            if getattr(outcome, name) != getattr(episode, name):
                found.append(f"episode {number}: {name} is {getattr(outcome, name)}, not {getattr(episode, name)}")
        limit = protocol.rules.max_steps
        if limit is not None and outcome.steps > limit:
            found.append(f"episode {number}: {outcome.steps} steps, {limit} are allowed")
        if outcome.success != (outcome.flags.get("success") is not None):
            found.append(f"episode {number}: success does not agree with its flags")
        if outcome.success and outcome.failure_stage:
            found.append(f"episode {number}: succeeded, and failed at {outcome.failure_stage}")
    missing = len(protocol.episodes) - len(result.outcomes)
    if missing > 0:
        found.append(f"{missing} of {len(protocol.episodes)} episodes are missing")
    return found
