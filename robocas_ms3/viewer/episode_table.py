"""Rows of the table: episodes, and skipped seeds according to ``failures.jsonl``."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.datasets.sources.provenance import compute_environment_id
from robocas_ms3.demos.failures import FAILURES_FILE, FailedAttempt


@dataclass(frozen=True)
class Row:
    """Row of the table: an episode, a skipped seed, or a decision with candidates.

    Attributes:
        n: episode number, or row of a decision; None: a skipped seed.
        steps: number of steps, or of the candidates of a decision.
        task: task, or kind of a decision.
        success: outcome of the episode, or of the chosen candidate; None: unknown.
        stages: stages at which attempts failed, or primitives of the candidates.
        damage: text on damaged values, which the page does not show.
    """

    n: int | None
    steps: int = 0
    instruction: str = ""
    task: str = ""
    object: str = ""
    seed: int | None = None
    success: bool | None = None
    split: str = ""
    stages: Sequence[str] = ()
    attempts: int | None = None
    damage: str = ""


@dataclass(frozen=True)
class TaskFailedAttempt(FailedAttempt):
    """Line of ``failures.jsonl`` with the task and the environment of the run; None: unknown."""

    task: str | None = None
    environment: str | None = None

    def belongs_to(self, env_info: Any) -> bool:
        """Return whether the attempt may belong to an episode with this ``env_info``."""
        if not self.environment or not isinstance(env_info, Mapping):
            return True
        return compute_environment_id(env_info) in ("", self.environment)


@dataclass(frozen=True)
class Failures:
    """Failed attempts of ``failures.jsonl`` by seed, and a note on damaged lines for the page."""

    by_seed: Mapping[int, list[TaskFailedAttempt]] = field(default_factory=dict)
    note: str = ""

    @classmethod
    def load(cls, folder: Path) -> Failures:
        """Read ``failures.jsonl`` of a folder; a missing file gives no attempts."""
        try:
            lines = JsonLinesFile[TaskFailedAttempt](folder / FAILURES_FILE, TaskFailedAttempt).read_lines()
        except OSError as error:
            return cls(note=f"`{FAILURES_FILE}` can't be read: {error.strerror}.")
        found: dict[int, list[TaskFailedAttempt]] = defaultdict(list)
        for line in lines:
            if line.record is not None:
                found[line.record.seed].append(line.record)
        damaged = [str(line.number) for line in lines if line.record is None]
        listed = ", ".join(damaged[:5]) + (", ..." if len(damaged) > 5 else "")
        return cls(dict(found), f"Damaged lines are not shown: {listed} of `{FAILURES_FILE}`." if damaged else "")

    def find_attempts(self, seed: int | None, env_info: Any = None) -> list[TaskFailedAttempt]:
        """Return the failed attempts of a seed that belong to an environment; [] if the seed is None."""
        return (
            [] if seed is None else [failure for failure in self.by_seed.get(seed, []) if failure.belongs_to(env_info)]
        )

    def make_skipped_rows(self, rows: Sequence[Row], env_infos: Sequence[Any]) -> list[Row]:
        """Return the rows of skipped seeds, which have no episode.

        Args:
            rows: rows of the episodes.
            env_infos: ``env_info`` of each episode, None if unknown.
        """
        environments: dict[int | None, list[Any]] = defaultdict(list)
        for row, env_info in zip(rows, env_infos, strict=True):
            environments[row.seed].append(env_info)
        tasks = {row.task for row in rows}
        task = tasks.pop() if len(tasks) == 1 else ""  # if the file lacks it
        lost = []
        for seed, of_seed in sorted(self.by_seed.items()):
            runs: dict[str | None, list[TaskFailedAttempt]] = defaultdict(list)
            for failure in of_seed:
                runs[failure.environment].append(failure)
            for of_run in runs.values():
                recorded = any(of_run[0].belongs_to(env_info) for env_info in environments[seed])
                if recorded or not any(failure.skipped for failure in of_run):
                    continue
                tried = [failure for failure in of_run if not failure.skipped]
                named = list_failed_stages(tried, {}) or ["skipped"]
                of_task = of_run[0].task or task
                lost.append(Row(None, task=of_task, seed=seed, success=False, stages=named, attempts=len(tried)))
        return lost


def list_failed_stages(failures: Iterable[FailedAttempt], recorded: Mapping[str, Any]) -> list[str]:
    """List the stages at which attempts failed: undone attempts, and recoveries ``recorded`` in the episode."""
    named = {failure.stage for failure in failures if not failure.skipped}
    return sorted(named | {recovery["stage"] for recovery in recorded.get("recoveries") or ()})


def describe_failures(failures: Iterable[FailedAttempt], recorded: Mapping[str, Any]) -> list[dict[str, str]]:
    """Describe failed attempts by stage, reason and text: undone ones, then recoveries ``recorded`` in the episode."""
    lines = [
        {"stage": f.stage, "reason": f.reason, "text": f"attempt {f.attempt + 1}, {f.seconds:.1f} s, undone"}
        for f in failures
        if not f.skipped
    ]
    for recovery in recorded.get("recoveries") or ():
        first, last = recovery["range"]
        text = f"recovered from, control steps {first} to {last}"
        lines.append({"stage": recovery["stage"], "reason": recovery["reason"], "text": text})
    return lines
