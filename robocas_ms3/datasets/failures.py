"""``failures.jsonl`` of the run that made a trajectory, in the dataset: which seeds were lost, and where."""

from __future__ import annotations

import json
from pathlib import Path

from robocas_ms3.files import replacing

FAILURES_FILE = "failures.jsonl"


def add_failures(run: Path, out: Path) -> None:
    """Add a run's lines that the dataset does not have yet.

    Args:
        run: folder with the trajectory; where there is no such file in it, nothing is done. Lines cut off by a crash
            stay there.
        out: the dataset.
    """
    known = _lines(out / FAILURES_FILE)
    new = [line for line in _lines(run / FAILURES_FILE) if line not in set(known) and _is_json(line)]
    if new:
        with replacing(out / FAILURES_FILE) as tmp:
            tmp.write_bytes(b"".join(line + b"\n" for line in known + new))


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines() if path.is_file() else []


def _is_json(line: bytes) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True
