"""Make of a LeRobot export what LeRobot's policies train on: what the socket sends, and the instruction as numbers.

    python -m robocas_ms3.baselines.lerobot.prepare DATASET OUT [--no-language]

Images and episodes stay as they are (videos are hard links). The state is that of `policy.STATE_NAMES`;
``observation.environment_state`` is the sentence embedding of a frame's instruction, as LeRobot's ACT and diffusion
policy read no text. Of the actions only ``action`` is left.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.baselines.dataset_checks import check_base_stands
from robocas_ms3.baselines.lerobot.policy import (
    ACTION,
    DIMENSIONS,
    EMBEDDING,
    STATE_NAMES,
    scale_embeddings,
    state_of,
)
from robocas_ms3.core.errors import DatasetError, RobocasError
from robocas_ms3.core.files import replacing_folder, write_json
from robocas_ms3.core.outputs import check_replaceable
from robocas_ms3.core.words import printable
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.records import episode_columns, frame_columns
from robocas_ms3.datasets.lerobot.schema import FEATURES, INDICES, INFO_FILE, STAGING, STATS_FILE, is_depth
from robocas_ms3.datasets.lerobot.tables import Column, check_columns, numbers, open_table, read_columns
from robocas_ms3.datasets.lerobot.variants import V3
from robocas_ms3.datasets.sources.files import read_json
from robocas_ms3.robots.quantities import GRIPPER_WIDTH, STATE, columns_of

Embed = Callable[[Sequence[str]], NDArray[np.float32]]
_WIDTHS = {feature.key: feature.width for feature in FEATURES}
_NOT_COPIED = ("data", "episodes", "robocas", "depth", ".parts", STAGING)
"""Folders that are written here, or that the policies do not need."""
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def prepare(source: Path, out: Path, embed: Embed | None) -> None:
    """Write the dataset; the folder appears when all is written.

    Args:
        source: of ``robocas convert --to lerobot``.
        out: to make.
        embed: texts to (N, 384) of unit length; None: no instruction, which policies then do not know.

    Raises:
        DatasetError: it is no such dataset, holds NaN, or its base drives.
        OutputExistsError: there is something at ``out``.
    """
    check_replaceable(out)
    info = _info(source)
    depths = [key for key, feature in info["features"].items() if is_depth(feature)]  # policies would take it for RGB
    with replacing_folder(out) as part:
        ignored = shutil.ignore_patterns(*_NOT_COPIED, *depths)
        shutil.copytree(source, part, ignore=ignored, copy_function=_link, dirs_exist_ok=True)
        vectors = None if embed is None else scale_embeddings(embed(LeRobotDataset(source).tasks))
        parts: dict[str, list[NDArray]] = {}
        for path in sorted((source / "data").rglob("*.parquet")):
            columns, indices = _columns(path, info["features"], vectors)
            for key, values in columns.items():
                parts.setdefault(key, []).append(values)
            lists = {
                key: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
                for key, values in columns.items()
            }
            _write(pa.table({**lists, **indices}), part / path.relative_to(source))
        for path in sorted((source / "meta" / "episodes").rglob("*.parquet")):
            _table(path, episode_columns((), info["features"]))  # bounded and checked, with texts as dictionaries
            table = pq.read_table(path)  # LeRobot reads no statistics of episodes, and these are of other columns
            left_out = ("stats/", *(f"videos/{key}/" for key in depths))
            names = [name for name in table.column_names if not name.startswith(left_out)]
            _write(table.select(names), part / path.relative_to(source))
        _write_meta(source, part, info, {key: np.concatenate(values) for key, values in parts.items()})


def _info(source: Path) -> dict[str, Any]:
    try:
        dataset = LeRobotDataset(source)
        info = dataset.info
        if dataset.layout is not V3:
            version = info["codebase_version"]
            raise DatasetError("another format", where=source, expected=V3.codebase_version, found=version)
        widths = {key: info["features"][key]["shape"] for key in _WIDTHS}
    except (DatasetError, KeyError) as error:
        fix = "Make one: robocas convert F.h5 --to lerobot --out DIR"
        raise DatasetError("no LeRobot dataset of ours", where=source, found=error, fix=fix) from error
    if widths != {key: [width] for key, width in _WIDTHS.items()}:
        raise DatasetError("another LeRobot dataset's columns", where=source, expected=_WIDTHS, found=widths)
    if not any(key.startswith("observation.images.") for key in info["features"]):
        raise DatasetError("no images", where=source, expected="at least one camera")
    return info


def _columns(
    path: Path, features: Mapping[str, Any], vectors: NDArray | None
) -> tuple[dict[str, NDArray], dict[str, pa.ChunkedArray]]:
    """Return the numbers (N, D) of a file by key, and the columns that stay as they are."""
    table = _table(path, frame_columns(features))
    read = {key: _numbers(table, key) for key in (STATE, ACTION, "action.base")}
    for key, values in read.items():
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise DatasetError("NaN or infinite value", where=f"{path}: {key}, row {row}", found=values[row].tolist())
    ends = np.flatnonzero(np.diff(table["episode_index"].to_numpy())) + 1
    for motion in np.split(read["action.base"], ends):
        check_base_stands(motion, path)
    parts = (read[STATE][:, columns_of(STATE)[key]] for key in ("ee_pos", "ee_orn", "robot_joints", GRIPPER_WIDTH))
    columns = {STATE: state_of(*parts), ACTION: read[ACTION]}
    if vectors is not None:
        places = table["task_index"].to_numpy()
        if len(places) and places.max() >= len(vectors):
            expected, where = f"0 to {len(vectors) - 1}", f"{path}, task_index"
            raise DatasetError("no such instruction", where=where, expected=expected, found=places.max())
        columns[EMBEDDING] = vectors[places]
    return columns, {key: table[key] for key in INDICES}


def _table(path: Path, columns: Mapping[str, Column]) -> pa.Table:
    with open_table(path) as file:
        table = read_columns(file, path, columns)
        check_columns(table, columns, path)
    return table


def _numbers(table: pa.Table, key: str) -> NDArray[np.float32]:
    values = numbers(table[key]).astype(np.float32)
    if values.shape[1] != _WIDTHS[key]:
        raise DatasetError("another width of a column", where=key, expected=_WIDTHS[key], found=values.shape[1])
    return values


def _write_meta(source: Path, part: Path, info: dict[str, Any], columns: dict[str, NDArray]) -> None:
    names = {STATE: list(STATE_NAMES), EMBEDDING: [f"e{number}" for number in range(DIMENSIONS)]}
    names[ACTION] = info["features"][ACTION]["names"]
    features = {
        key: {"dtype": "float32", "shape": [values.shape[1]], "names": names[key]} for key, values in columns.items()
    }
    features |= {
        key: feature
        for key, feature in info["features"].items()
        if (key.startswith("observation.images.") and not is_depth(feature)) or key in INDICES
    }
    stats = {key: values for key, values in read_json(source / STATS_FILE).items() if key in features}
    stats |= {key: _stats(values.astype(np.float64)) for key, values in columns.items()}
    write_json(part / INFO_FILE, {**info, "features": features})
    write_json(part / STATS_FILE, stats)


def _stats(values: NDArray[np.float64]) -> dict[str, list]:
    found = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    rows = dict(zip(_QUANTILES, np.quantile(values, list(_QUANTILES.values()), axis=0).tolist(), strict=True))
    return {**found, "count": [len(values)], **rows}


def _write(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _link(source: str, target: str) -> None:
    with suppress(OSError):  # another disk, or one without links
        if source.endswith(".mp4"):
            return os.link(source, target)
    shutil.copyfile(source, target)


def main(words: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code."""
    parser = argparse.ArgumentParser(description="Make a LeRobot export fit for LeRobot's policies on our socket.")
    parser.add_argument("dataset", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--no-language", action="store_true", help="leave the instruction out")
    cfg = parser.parse_args(words)
    try:
        embed = None
        if not cfg.no_language:
            from robocas_ms3.scenes.language.embed import TextEmbedder

            embed = TextEmbedder()
        prepare(cfg.dataset, cfg.out, embed)
    except RobocasError as error:
        print(printable(f"error: {error}"), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
