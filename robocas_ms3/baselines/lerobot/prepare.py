"""Prepare a LeRobot dataset for LeRobot's training: reduce it, and add embeddings.

    python -m robocas_ms3.baselines.lerobot.prepare DATASET OUT [--no-language]

The new dataset has only values that the policy socket sends too. Images and episodes do not change (videos are hard
links). ``observation.state`` has the values in `policy.STATE_NAMES`.
``observation.environment_state`` is the embedding of the frame's instruction, because LeRobot's ACT and diffusion
policy do not read text. The only action is ``action``.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.baselines.dataset_checks import check_base_is_fixed
from robocas_ms3.baselines.lerobot.policy import (
    ACTION,
    DIMENSIONS,
    EMBEDDING,
    STATE_NAMES,
    make_state,
    scale_embeddings,
)
from robocas_ms3.core.errors import DatasetError, RobocasError
from robocas_ms3.core.files import atomic_folder, write_json
from robocas_ms3.core.output_folder import check_replaceable
from robocas_ms3.core.text import escape_controls
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset, LeRobotEpisode
from robocas_ms3.datasets.lerobot.schema import INDICES, INFO_FILE, STAGING, STATS_FILE, image_key, is_depth
from robocas_ms3.datasets.lerobot.stats import compute_stats
from robocas_ms3.datasets.lerobot.tables import to_column
from robocas_ms3.datasets.lerobot.variants import V3
from robocas_ms3.datasets.sources.files import read_json
from robocas_ms3.robots.quantities import GRIPPER_WIDTH, STATE

Embed = Callable[[Sequence[str]], NDArray[np.float32]]
_NOT_COPIED = ("data", "episodes", "robocas", "depth", ".episodes", STAGING)
"""Folders that `prepare_dataset` writes itself, or that the policies do not need."""


def prepare_dataset(source: Path, out: Path, embed: Embed | None) -> None:
    """Write a LeRobot dataset that is reduced to the data that the policy socket sends.

    The output folder appears when it is complete.

    Args:
        source: dataset folder of ``robocas convert --to lerobot``.
        out: output folder.
        embed: function that returns the embeddings (N, 384) of N texts, with unit length; None: no embeddings.

    Raises:
        DatasetError: the source is another dataset, or the base of the robot moves in it.
        OutputExistsError: the output folder exists and is not empty.
    """
    check_replaceable(out)
    dataset = _open_export(source)
    features = dataset.info["features"]
    depths = [key for key, feature in features.items() if is_depth(feature)]  # policies would read them as RGB
    with atomic_folder(out) as part:
        ignored = shutil.ignore_patterns(*_NOT_COPIED, *depths)
        shutil.copytree(source, part, ignore=ignored, copy_function=_link_or_copy, dirs_exist_ok=True)
        vectors: dict[str, NDArray[np.float32]] = {}
        if embed is not None:
            vectors = dict(zip(dataset.tasks, scale_embeddings(embed(dataset.tasks)), strict=True))
        parts: dict[str, list[NDArray]] = defaultdict(list)
        for path, rows in dataset.rows_by_file("data").items():
            tables = []
            for episode in (dataset.episode(row["episode_index"]) for row in rows):
                columns = _make_columns(episode, vectors)
                for key, values in columns.items():
                    parts[key].append(values)
                indices = {key: episode.frame_table.column(key) for key in INDICES}
                tables.append(pa.table({**{key: to_column(values) for key, values in columns.items()}, **indices}))
            _write_table(pa.concat_tables(tables), part / path.relative_to(source))
        for path in sorted((source / "meta" / "episodes").rglob("*.parquet")):
            table = pq.read_table(
                path
            )  # statistics per episode: LeRobot does not read them, and they are of other columns
            left_out = ("stats/", *(f"videos/{key}/" for key in depths))
            names = [name for name in table.column_names if not name.startswith(left_out)]
            _write_table(table.select(names), part / path.relative_to(source))
        _write_meta(dataset, part, {key: np.concatenate(values) for key, values in parts.items()})


def _open_export(source: Path) -> LeRobotDataset:
    what = "not a LeRobot dataset written by robocas convert"
    fix = "Convert a trajectory: robocas convert TRAJECTORY --to lerobot --out DIR."
    try:
        dataset = LeRobotDataset(source)
    except DatasetError as error:
        raise DatasetError(what, where=source, found=error, fix=fix) from error
    if dataset.file_layout is not V3 or not dataset.has_robocas_features or not dataset.cameras:
        expected = f"format {V3.codebase_version}, the columns of robocas convert, and a camera"
        found = f"format {dataset.info['codebase_version']}, cameras {', '.join(dataset.cameras) or 'none'}"
        raise DatasetError(what, where=source, expected=expected, found=found, fix=fix)
    return dataset


def _make_columns(episode: LeRobotEpisode, vectors: dict[str, NDArray[np.float32]]) -> dict[str, NDArray]:
    arrays, steps = episode.arrays, episode.steps
    check_base_is_fixed(arrays["rel_agv_pose"], episode.where)
    parts = (arrays[key].reshape(steps, -1) for key in ("ee_pos", "ee_orn", "robot_joints", GRIPPER_WIDTH))
    columns: dict[str, NDArray] = {STATE: make_state(*parts), ACTION: episode.columns[ACTION].astype(np.float32)}
    if vectors:
        columns[EMBEDDING] = np.tile(vectors[episode.instruction], (steps, 1))
    return columns


def _write_meta(dataset: LeRobotDataset, part: Path, columns: dict[str, NDArray]) -> None:
    info, names = dataset.info, {STATE: list(STATE_NAMES), EMBEDDING: [f"e{number}" for number in range(DIMENSIONS)]}
    names[ACTION] = info["features"][ACTION]["names"]
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [values.shape[1]], "names": names[key]} for key, values in columns.items()
    }
    features |= {key: info["features"][key] for key in (*map(image_key, dataset.cameras), *INDICES)}
    stats = {key: values for key, values in read_json(dataset.root / STATS_FILE).items() if key in features}
    stats |= {key: compute_stats(values) for key, values in columns.items()}
    write_json(part / INFO_FILE, {**info, "features": features})
    write_json(part / STATS_FILE, stats)


def _write_table(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _link_or_copy(source: str, target: str) -> None:
    with suppress(OSError):  # another disk, or a disk without hard links
        if source.endswith(".mp4"):
            return os.link(source, target)
    shutil.copyfile(source, target)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments (None: those of the process); return the exit status."""
    parser = argparse.ArgumentParser(
        description="Reduce a LeRobot dataset to the data that the policy socket sends, to train LeRobot's policies."
    )
    parser.add_argument("dataset", type=Path, help="dataset folder of `robocas convert --to lerobot`")
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--no-language", action="store_true", help="omit the embedding of the instruction")
    cfg = parser.parse_args(argv)
    try:
        embed = None
        if not cfg.no_language:
            from robocas_ms3.scenes.language.embed import TextEmbedder

            embed = TextEmbedder()
        prepare_dataset(cfg.dataset, cfg.out, embed)
    except RobocasError as error:
        print(escape_controls(f"error: {error}"), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
