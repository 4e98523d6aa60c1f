"""The folder of a RoboCAS dataset as an output of a command."""

from __future__ import annotations

from typing import Any

from robocas_ms3.core.outputs import FolderKind
from robocas_ms3.datasets import schema
from robocas_ms3.demos.recordings.entries import versions

MARKS = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
"""A folder with one of these is a RoboCAS dataset, whole or not."""


def with_versions(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record with the versions of today if it does not name them all, as that of merged datasets."""
    now, made_with = versions(), record.get("made_with")
    is_whole = isinstance(made_with, dict) and now.keys() <= made_with.keys()
    return record if is_whole else {**record, "made_with": now}


DATASET = FolderKind("robocas convert", (schema.CONVERSION_FILE,), "rate_hz", marks=MARKS, upgrade=with_versions)
