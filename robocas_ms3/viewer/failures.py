"""What is known of attempts that failed: ``failures.jsonl`` of a run, and recoveries left in an episode."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robocas_ms3.demos.ledger import Failure, Ledger

FAILURES_FILE = "failures.jsonl"


def read_failures(folder: Path) -> dict[int, list[Failure]]:
    """{seed: failures} of a run's folder; empty where there is no file."""
    found: dict[int, list[Failure]] = defaultdict(list)
    for failure in Ledger(folder / FAILURES_FILE).read():
        found[failure.seed].append(failure)
    return dict(found)


def of_seed(found: Mapping[int, list[Failure]], seed: Any) -> list[Failure]:
    """Of one seed; none where it is not known."""
    return found.get(seed, []) if isinstance(seed, int) else []


def stages(failures: Iterable[Failure], recorded: Mapping[str, Any]) -> list[str]:
    """Where attempts at an episode failed."""
    named = {failure.stage for failure in failures if not failure.gave_up}
    return sorted(named | {str(kept["stage"]) for kept in recorded.get("recoveries") or () if "stage" in kept})


def describe(failures: Iterable[Failure], recorded: Mapping[str, Any]) -> list[dict[str, str]]:
    """The same for people, one attempt a line."""
    lines = [
        {"stage": f.stage, "reason": f.reason, "text": f"attempt {f.attempt + 1}, {f.seconds:.1f} s, undone"}
        for f in failures
        if not f.gave_up
    ]
    for kept in recorded.get("recoveries") or ():
        first, last = kept.get("range", ("?", "?"))
        text = f"recovered from, control steps {first} to {last}"
        lines.append({"stage": str(kept.get("stage", "")), "reason": str(kept.get("reason", "")), "text": text})
    return lines
