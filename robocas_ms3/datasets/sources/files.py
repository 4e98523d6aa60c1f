"""Read files of a dataset; errors name the path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, load_json, load_npy
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets import schema

CAMERA_LIMIT = 2**22
"""Largest file of intrinsics or poses in bytes; a pose has 128."""
SEE_VALIDATE = "Run robocas validate for all violations."


def no_dataset_error(root: Path, expected: str) -> DatasetError:
    """Make the error for a folder without a dataset; it suggests a dataset or trajectory file inside."""
    if (root / "meta" / "info.json").is_file():
        return DatasetError("this is a LeRobot dataset", where=root, expected="a RoboCAS folder")
    # the output folder of a plan has its datasets in datasets/
    places = [
        f"{folder}*/{name}" for folder in ("", "datasets/") for name in (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
    ]
    found = (sorted(root.glob(place)) for place in [*places, "*.h5"]) if root.is_dir() else ()
    meant = next((paths[0] if paths[0].suffix == ".h5" else paths[0].parent for paths in found if paths), None)
    fix = f"Did you mean {meant}?" if meant else "Make one with robocas convert."
    return DatasetError("no dataset here", where=root, expected=expected, fix=fix)


def episode_info(info: Mapping[str, Any], number: int | None) -> dict[str, Any]:
    """Return the entries of an episode in the content of ``data_info.json``, by key.

    The keys are ``ep_length``, ``language_goal`` and ``step_goals``.
    """
    tables = {key: info.get(key) for key in ("ep_length", "language_goal", "step_goals")}
    return {k: table[str(number)] for k, table in tables.items() if isinstance(table, dict) and str(number) in table}


def read_json(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file; empty if the file does not exist."""
    try:
        content = load_json(path)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise DatasetError("damaged JSON file", where=path, found=one_line(error)) from error
    if not isinstance(content, dict):
        raise DatasetError("damaged JSON file", where=path, expected="an object", found=type(content).__name__)
    return content


def read_array(path: Path) -> NDArray[np.float64]:
    """Read an array of numbers from a ``.npy`` file, such as intrinsics or a pose."""
    try:
        array = load_npy(path, CAMERA_LIMIT)
        if array.dtype.kind not in "fiu":
            raise ValueError("not an array of numbers")
    except DAMAGED_FILE_ERRORS as error:
        raise DatasetError("this array can't be read", where=path, found=one_line(error), fix=SEE_VALIDATE) from error
    return array
