"""What of folders may be replaced by a dataset; the rest of the rules: `robocas_ms3.outputs`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robocas_ms3 import outputs
from robocas_ms3.datasets import schema
from robocas_ms3.errors import DatasetError

MARKS = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
"""A folder with one of these is a RoboCAS dataset, whole or not."""


def check_overwrite(out: Path, marks: Sequence[str] = MARKS, what: str = "a dataset") -> None:
    """Delete datasets only; see `outputs.check_overwrite`.

    Raises:
        DatasetError: it holds something else.
    """
    outputs.check_overwrite(out, marks, what, DatasetError)
