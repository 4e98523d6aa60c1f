"""``failures.jsonl`` of the run that made a trajectory, in the dataset: which seeds were lost, and where."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocas_ms3.datasets.sources.provenance import environment_of, task_of
from robocas_ms3.files import replacing

FAILURES_FILE = "failures.jsonl"


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
    known = _lines(out / FAILURES_FILE)
    new = []
    for line in _lines(run / FAILURES_FILE):
        marked = _marked(line, made_in)
        if marked and not {line, marked} & set(known):
            new.append(marked)
    if new:
        with replacing(out / FAILURES_FILE) as tmp:
            tmp.write_bytes(b"".join(line + b"\n" for line in known + new))


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines() if path.is_file() else []


def _marked(line: bytes, made_in: Mapping[str, Any]) -> bytes:
    """The line with more keys; empty where it is no whole one."""
    try:
        content = json.loads(line)
    except ValueError:
        return b""
    return json.dumps({**content, **made_in}).encode() if isinstance(content, dict) else b""
