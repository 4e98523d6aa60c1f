"""What is known of attempts that failed: ``failures.jsonl`` of a run or dataset, and recoveries left in an episode."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robocas_ms3.core.ledger import Ledger
from robocas_ms3.datasets.sources.provenance import environment_of
from robocas_ms3.demos.ledger import FAILURES_FILE, Failure
from robocas_ms3.viewer.parts import row


@dataclass(frozen=True)
class FailedAttempt(Failure):
    """A line of the file.

    Attributes:
        task, environment: which run it is of, where a dataset may be of several; None where it does not say.
    """

    task: str | None = None
    environment: str | None = None

    def is_of(self, env_info: Any) -> bool:
        """Whether it is of a run in this environment, as far as either is known."""
        if not self.environment or not isinstance(env_info, Mapping):
            return True
        return environment_of(env_info) in ("", self.environment)


@dataclass(frozen=True)
class Failures:
    """The file.

    Attributes:
        by_seed: {seed: failures}.
        note: which lines are damaged, for people.
    """

    by_seed: Mapping[int, list[FailedAttempt]] = field(default_factory=dict)
    note: str = ""

    @classmethod
    def read(cls, folder: Path) -> Failures:
        """Read that of a folder; nothing where there is none."""
        try:
            lines = Ledger[FailedAttempt](folder / FAILURES_FILE, FailedAttempt).lines()
        except OSError as error:
            return cls(note=f"`{FAILURES_FILE}` can't be read: {error.strerror}.")
        found: dict[int, list[FailedAttempt]] = defaultdict(list)
        for line in lines:
            if line.record is not None:
                found[line.record.seed].append(line.record)
        return cls(dict(found), _damaged([str(line.number) for line in lines if line.record is None]))

    def of_seed(self, seed: int | None, env_info: Any = None) -> list[FailedAttempt]:
        """Of one seed in an environment; none where the seed is not known."""
        return [] if seed is None else [told for told in self.by_seed.get(seed, []) if told.is_of(env_info)]

    def given_up(self, rows: Iterable[Mapping[str, Any]], env_infos: Iterable[Any]) -> list[dict[str, Any]]:
        """Rows of the seeds that were given up, but those that have an episode after all.

        Args:
            rows: of the episodes.
            env_infos: the environment of each, as far as it is known.
        """
        there: dict[int, list[Any]] = defaultdict(list)
        tasks = set()
        for entry, env_info in zip(rows, env_infos, strict=True):
            there[entry["seed"]].append(env_info)
            tasks.add(entry["task"])
        task = tasks.pop() if len(tasks) == 1 else ""  # where the file does not say
        lost = []
        for seed, of_seed in sorted(self.by_seed.items()):
            runs: dict[str | None, list[FailedAttempt]] = defaultdict(list)
            for told in of_seed:
                runs[told.environment].append(told)
            for of_run in runs.values():
                made = any(of_run[0].is_of(env_info) for env_info in there[seed])
                if not made and any(told.gave_up for told in of_run):
                    tried = [told for told in of_run if not told.gave_up]
                    lost.append(_lost(seed, of_run[0].task or task, tried))
        return lost


def _lost(seed: int, task: str, tried: list[FailedAttempt]) -> dict[str, Any]:
    named = stages(tried, {}) or ["given up"]
    return row(None, task=task, seed=seed, success=False, stages=named, attempts=len(tried))


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
