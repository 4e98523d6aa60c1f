"""Where training samples come from: a RoboCAS folder, or a trajectory file, which holds no pictures.

A source reads an overview when it is made and everything else when it is asked for; it keeps no file open, so it may
be pickled and forked.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from robocas_ms3.datasets.sources.folder import FolderSource
from robocas_ms3.datasets.sources.reader import Episode
from robocas_ms3.datasets.sources.trajectory import TrajectorySource
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.subgoals import SubGoal

Split = Literal["train", "val", "all"]


class Source(Protocol):
    """Episodes by number.

    Attributes:
        path: the folder or file.
        rate_hz: steps a second.
        lengths: number -> T.
        cameras: that there are pictures of.
        has_depth: whether depth is there.
        has_embeddings: of texts.
    """

    path: Path
    rate_hz: float
    lengths: dict[int, int]
    cameras: tuple[str, ...]
    has_depth: bool
    has_embeddings: bool

    def split(self, side: Split) -> list[int]:
        """Numbers of the episodes of one side."""
        ...

    def goals(self, number: int) -> list[SubGoal]:
        """Sub-goals of an episode; empty where they are not known."""
        ...

    def arrays(self, number: int, keys: Sequence[str]) -> dict[str, NDArray]:
        """Some of an episode's arrays, by the schema's keys."""
        ...

    def action_space(self) -> dict[str, Any]:
        """As in ``data_info.json``."""
        ...

    def episode(self, number: int) -> Episode:
        """An episode's pictures."""
        ...


def open_source(path: Path | str, *, rate_hz: float | None = None, include_failed: bool = False) -> Source:
    """Open a RoboCAS folder or a trajectory file.

    Args:
        path: of it; a file is taken for a trajectory.
        rate_hz: steps a second, for trajectories (default 5); a folder has its own.
        include_failed: for trajectories: also episodes without success.

    Raises:
        DatasetError: it can't be read, or the folder is of another rate.
    """
    path = Path(path)
    if path.is_file() or path.suffix in {".h5", ".hdf5"}:
        return TrajectorySource(path, rate_hz=5.0 if rate_hz is None else rate_hz, include_failed=include_failed)
    source = FolderSource(path)
    if rate_hz is not None and rate_hz != source.rate_hz:
        raise DatasetError(
            "the dataset has another rate",
            where=path,
            expected=f"{source.rate_hz:g} Hz",
            found=f"{rate_hz:g}",
            fix="Convert the trajectory again with this --rate.",
        )
    return source
