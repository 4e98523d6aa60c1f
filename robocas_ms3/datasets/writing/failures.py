"""``failures.jsonl`` of the run that made a trajectory, in the dataset: which seeds were lost, and where."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocas_ms3.core.ledger import Ledger
from robocas_ms3.datasets.sources.provenance import environment_of, task_of
from robocas_ms3.demos.ledger import FAILURES_FILE


def add_failures(run: Path, out: Path, env_info: Mapping[str, Any]) -> None:
    """Add a run's lines that the dataset does not have yet.

    Each gets ``task`` and ``environment``, as a seed alone does not tell which of several runs it is of.

    Args:
        run: folder with the trajectory; where there is no such file in it, nothing is done. Lines cut off by a crash
            stay there.
        out: the dataset.
        env_info: of the trajectory.
    """
    made_in = {"task": task_of(str(env_info.get("env_id"))), "environment": environment_of(env_info)}
    there = _lines_of(out)
    known = {_key(line) for line in there.read()}
    marked = ((line, {**line, **made_in}) for line in _lines_of(run).read())
    new = [line for before, line in marked if not {_key(before), _key(line)} & known]
    if new:  # anew: files of a dataset may be linked from another one
        there.rewrite([*there.read(), *new])


def _lines_of(folder: Path) -> Ledger[dict[str, Any]]:
    return Ledger(folder / FAILURES_FILE, dict[str, Any])


def _key(line: Mapping[str, Any]) -> str:
    return json.dumps(line, sort_keys=True)
