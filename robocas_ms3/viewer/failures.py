"""What is known of attempts that failed: ``failures.jsonl`` of a run or dataset, and recoveries left in an episode."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from robocas_ms3.demos.ledger import Failure
from robocas_ms3.viewer.source import row

FAILURES_FILE = "failures.jsonl"
_LINE = TypeAdapter(Failure)


@dataclass(frozen=True)
class Failures:
    """The file.

    Attributes:
        by_seed: {seed: failures}.
        note: which lines are damaged, for people.
    """

    by_seed: Mapping[int, list[Failure]] = field(default_factory=dict)
    note: str = ""

    @classmethod
    def read(cls, folder: Path) -> Failures:
        """Read that of a folder; nothing where there is none."""
        try:
            lines = (folder / FAILURES_FILE).read_text(encoding="utf-8", errors="replace").split("\n")
        except FileNotFoundError:
            return cls()
        except OSError as error:
            return cls(note=f"`{FAILURES_FILE}` can't be read: {error.strerror}.")
        found: dict[int, list[Failure]] = defaultdict(list)
        damaged = []
        for number, line in enumerate(lines, 1):
            try:
                if line.strip():
                    failure = _LINE.validate_json(line, strict=True)
                    found[failure.seed].append(failure)
            except ValidationError:
                damaged.append(str(number))
        return cls(dict(found), _damaged(damaged))

    def of_seed(self, seed: int | None) -> list[Failure]:
        """Of one seed; none where it is not known."""
        return [] if seed is None else self.by_seed.get(seed, [])

    def given_up(self, rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Rows of the seeds that were given up, but those that have an episode after all."""
        there, tasks = {entry["seed"] for entry in rows}, {entry["task"] for entry in rows}
        task = tasks.pop() if len(tasks) == 1 else ""  # the file does not say
        lost = []
        for seed, failures in sorted(self.by_seed.items()):
            if seed not in there and any(failure.gave_up for failure in failures):
                tried = [failure for failure in failures if not failure.gave_up]
                named = stages(tried, {}) or ["given up"]
                lost.append(row(None, task=task, seed=seed, success=False, stages=named, attempts=len(tried)))
        return lost


def _damaged(lines: list[str]) -> str:
    if not lines:
        return ""
    if len(lines) == 1:
        return f"Line {lines[0]} of `{FAILURES_FILE}` is damaged and left out."
    named = ", ".join(lines[:5]) + (", ..." if len(lines) > 5 else "")
    return f"{len(lines)} lines of `{FAILURES_FILE}` are damaged and left out: {named}"


def stages(failures: Iterable[Failure], recorded: Mapping[str, Any]) -> list[str]:
    """Where attempts at an episode failed."""
    named = {failure.stage for failure in failures if not failure.gave_up}
    return sorted(named | {kept["stage"] for kept in recorded.get("recoveries") or ()})


def describe(failures: Iterable[Failure], recorded: Mapping[str, Any]) -> list[dict[str, str]]:
    """The same for people, one attempt a line."""
    lines = [
        {"stage": f.stage, "reason": f.reason, "text": f"attempt {f.attempt + 1}, {f.seconds:.1f} s, undone"}
        for f in failures
        if not f.gave_up
    ]
    for kept in recorded.get("recoveries") or ():
        first, last = kept["range"]
        text = f"recovered from, control steps {first} to {last}"
        lines.append({"stage": kept["stage"], "reason": kept["reason"], "text": text})
    return lines
