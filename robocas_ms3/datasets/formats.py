"""The formats of episodes, in one table: what lies on disk tells which one it is.

Another package adds one through an entry point of the group ``robocas_ms3.formats`` that names a `Format`;
docs/extending.md.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.extensions import Registry
from robocas_ms3.core.signals import forbid_exit
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.episode_source import EpisodeSource

GROUP = "robocas_ms3.formats"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Format:
    """A format. What it does is named, ``module:function``, and imported when it is asked for.

    Attributes:
        name: of ``robocas convert --to``.
        title: for people.
        matches: whether a path matches such episodes, whole or not; reads little.
        reader: (path, *, rate_hz=None, include_failed=False) -> `EpisodeSource`.
        writer: (`writing.settings.ConversionSettings`, *, on_start=None, on_episode=None) -> `Conversion`, see
            `writing.convert.convert`; empty: it can't be written.
        checker: (root, *, on_episode=None) -> `checks.dataset.ValidationReport`; empty: there is none.
        options: flags of ``robocas convert`` that not every format has, of those that the writer heeds.
    """

    name: str
    title: str
    matches: Callable[[Path], bool]
    reader: str
    writer: str = ""
    checker: str = ""
    options: tuple[str, ...] = ()

    def load(self, name: str) -> Callable[..., Any]:
        path: str = getattr(self, name)
        if not path:
            raise DatasetError(f"this format has no {name}", where=self.title)
        module, _, function = path.partition(":")
        try:
            with forbid_exit(f"{name} {path}"):
                return getattr(import_module(module), function)
        except (ImportError, AttributeError) as error:
            raise DatasetError(f"the {name} of this format can't be imported", where=path, found=error) from error


def _is_robocas(path: Path) -> bool:
    marked = (path / schema.CONVERSION_FILE).is_file() or (path / schema.DATA_INFO_FILE).is_file()
    return marked or (path.is_dir() and any(path.glob("episode_" + "[0-9]" * 7)))


_PACKAGE = "robocas_ms3.datasets"
_BUILTIN = (
    Format(
        "trajectory",
        "trajectory file",
        lambda path: path.is_file() or path.suffix in {".h5", ".hdf5"},
        f"{_PACKAGE}.sources.trajectory:TrajectorySource",
    ),
    Format(
        "lerobot",
        "LeRobot dataset",
        lambda path: (path / "meta" / "info.json").is_file(),
        f"{_PACKAGE}.lerobot.reader:open_lerobot",
        f"{_PACKAGE}.lerobot.convert:convert_lerobot",
        f"{_PACKAGE}.lerobot.check:check_lerobot",
        ("codec", "lerobot_version", "skip_errors"),
    ),
    Format(
        "robocas",
        "RoboCAS folder",
        _is_robocas,
        f"{_PACKAGE}.sources.reader:open_folder",
        f"{_PACKAGE}.conversion.convert:convert",
        f"{_PACKAGE}.checks.dataset:validate",
        ("append", "image_format", "skip_errors"),
    ),
)
FORMATS: Registry[Format] = Registry("dataset format", GROUP, Format, {one.name: one for one in _BUILTIN})
"""Formats by name."""


def detect_format(path: Path) -> Format | None:
    """Return the format of a path, None if it has none; formats of other packages are asked first."""
    for name in reversed(list(FORMATS)):
        try:
            if FORMATS[name].matches(path):
                return FORMATS[name]
        except Exception as error:  # another package's, of a path that it did not think of
            _log.debug("%s: whether it matches %s can't be told: %s", name, path, error)
    return None


def open_source(path: Path | str, *, rate_hz: float | None = None, include_failed: bool = False) -> EpisodeSource:
    """Open a trajectory file or dataset of any format.

    ``rate_hz`` (default 5) and ``include_failed`` are for trajectories; a dataset has its own rate.

    Raises:
        DatasetError: it can't be read, or the dataset is of another rate.
    """
    path = Path(path)
    found = detect_format(path) or FORMATS["robocas"]  # which says what is wrong, and what may have been meant
    return found.load("reader")(path, rate_hz=rate_hz, include_failed=include_failed)
