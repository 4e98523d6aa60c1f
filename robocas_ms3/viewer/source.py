"""What `robocas view` opens: a trajectory file or a dataset of any format."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.formats import format_of
from robocas_ms3.viewer.content import PageContent

_OURS = {"trajectory": "TrajectoryContent", "lerobot": "LeRobotContent", "robocas": "FolderContent"}
"""Formats for which the page has additions: each in the module of its name, imported when it is needed."""


def open_source(path: Path | str) -> PageContent:
    """Open a trajectory file or its folder, a RoboCAS folder, a LeRobot folder, or another package's format.

    Raises:
        DatasetError: it is none of them, or damaged.
    """
    path = Path(path)
    inside = path / "trajectory.h5"
    path = inside if inside.is_file() else path
    found = format_of(path)
    other_file = found is None or (found.name == "trajectory" and path.suffix not in (".h5", ".hdf5"))
    if other_file and not path.is_dir():
        raise DatasetError(
            "nothing to view here",
            where=path,
            expected="a trajectory.h5 of robocas generate, a RoboCAS folder or a LeRobot folder",
            found="no such file or folder" if not path.exists() else "another kind of file",
        )
    name = found.name if found else "robocas"  # which says what is wrong, and what may have been meant
    if name in _OURS:
        return getattr(import_module(f"robocas_ms3.viewer.{name}"), _OURS[name])(path)
    assert found is not None
    return PageContent(found.part("reader")(path), found.title)
