"""Check the statistics of a LeRobot dataset against its data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.violation import Violation, read_object
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check_frames import Ranges
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.records import StatsLine, read_lines
from robocas_ms3.datasets.lerobot.stats import QUANTILES, shape_of
from robocas_ms3.datasets.sources.tolerant import first_line

_NAMES = {"min", "max", "mean", "std", "count"}


def check_statistics(dataset: LeRobotDataset, ranges: Ranges) -> Iterator[Violation]:
    """Check that the statistics have every feature, and the ranges that the data have."""
    if dataset.layout.one_file_per_episode:
        yield from _check_lines(dataset)
        if not (dataset.root / schema.STATS_FILE).exists():  # of an older format, and optional
            return
    stats, wrong = read_object(dataset.root, schema.STATS_FILE, absent="JSON")
    if wrong:
        yield from wrong
        return
    for key, feature in dataset.info["features"].items():
        if feature["dtype"] in ("string", "language"):
            continue
        found = stats.get(key, {})
        if not isinstance(found, dict):
            yield Violation(schema.STATS_FILE, key, "an object", type(found).__name__)
            continue
        missing = {*_NAMES, *QUANTILES} - set(found)
        if missing:
            yield Violation(schema.STATS_FILE, key, ", ".join(sorted(missing)), "nothing")
            continue
        shape = (feature["shape"][2], 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
        wrong = [name for name, value in found.items() if name != "count" and shape_of(value) != shape]
        if wrong:
            shown = f"{shape_of(found[wrong[0]])}"
            yield Violation(schema.STATS_FILE, f"{key}, {wrong[0]}", f"shape {shape}", shown)
        elif outside := _outside(found):
            yield Violation(schema.STATS_FILE, f"{key}, {outside}", "between min and max", str(found[outside])[:80])
        elif key in ranges:
            low, high, count = ranges[key]
            same = np.allclose(found["min"], low, atol=1e-6) and np.allclose(found["max"], high, atol=1e-6)
            if not same or found["count"] != [count]:
                expected = f"min {low.tolist()}, max {high.tolist()}, count {count}"
                text = f"min {found['min']}, max {found['max']}, count {found['count']}"
                yield Violation(schema.STATS_FILE, key, expected, text)


def _check_lines(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check that each episode has statistics of every feature."""
    features = {key for key, feature in dataset.info["features"].items() if feature["dtype"] not in ("string", "image")}
    try:
        lines = read_lines(dataset.root / schema.STATS_LINES, StatsLine, len(dataset.rows))
    except DatasetError as error:
        yield Violation(schema.STATS_LINES, "", "readable lines", first_line(error))
        return
    if sorted(line.episode_index for line in lines) != sorted(dataset.row_of):
        yield Violation(schema.STATS_LINES, "episode_index", "each episode once", "others")
    for line in lines:
        missing = sorted(key for key in features if not set(line.stats.get(key, {})) >= _NAMES)
        if missing:
            where = f"episode {line.episode_index}, {missing[0]}"
            yield Violation(schema.STATS_LINES, where, ", ".join(sorted(_NAMES)), "some are missing")


def _outside(found: Mapping[str, Any]) -> str | None:
    """Return the first statistic of a feature that is outside of the range, or None."""
    low, high = (np.asarray(found[name], np.float64) for name in ("min", "max"))
    slack = 1e-3 * (1 + np.abs(low) + np.abs(high))  # of histograms and float32
    bounds = {name: (low - slack, high + slack) for name in ("mean", *QUANTILES)} | {"std": (0, high - low + slack)}
    return next(
        (k for k, (a, b) in bounds.items() if not ((a <= np.array(found[k])) & (np.array(found[k]) <= b)).all()), None
    )
