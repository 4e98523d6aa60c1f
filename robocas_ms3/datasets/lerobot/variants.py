"""File layouts and features of LeRobot datasets, by the LeRobot version that reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from robocas_ms3.core.errors import DatasetError

CHUNK_FILES = 1000
"""Files per chunk folder."""
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_EPISODES = f"meta/episodes/{_FILE}.parquet"
_EPISODE = "episode_{episode_index:06d}"
_EPISODE_CHUNK = "chunk-{episode_chunk:03d}"


@dataclass(frozen=True)
class FileLayout:
    """Paths of the files of a LeRobot format version.

    Attributes:
        codebase_version: format version in ``info.json``.
        data: path pattern of data tables, as in ``info.json``.
        video: path pattern of videos, as in ``info.json``.
        depth: path pattern of FFV1 depth files, which LeRobot does not read.
        one_file_per_episode: whether each episode has its own files; then the tables in ``meta`` are JSON lines.
    """

    codebase_version: str
    data: str
    video: str
    depth: str
    one_file_per_episode: bool = False

    def file_path(self, root: Path, prefix: str, chunk: int, file: int) -> Path:
        """Return the path of a file by its chunk and file number.

        ``prefix`` is ``data``, ``meta/episodes``, ``videos/KEY`` or ``depth/CAMERA``, as in column names of
        ``meta/episodes``.
        """
        kind, _, name = prefix.partition("/")
        pattern = {"data": self.data, "videos": self.video, "depth": self.depth, "meta": _EPISODES}[kind]
        numbers = {"chunk_index": chunk, "episode_chunk": chunk, "file_index": file}
        numbers["episode_index"] = chunk * CHUNK_FILES + file
        return root / pattern.format(**numbers, video_key=name, camera=name)

    def episode_path(self, root: Path, prefix: str, row: Mapping[str, Any]) -> Path:
        return self.file_path(root, prefix, row[f"{prefix}/chunk_index"], row[f"{prefix}/file_index"])


V3 = FileLayout("v3.0", f"data/{_FILE}.parquet", f"videos/{{video_key}}/{_FILE}.mp4", f"depth/{{camera}}/{_FILE}.mkv")
V21 = FileLayout(
    "v2.1",
    f"data/{_EPISODE_CHUNK}/{_EPISODE}.parquet",
    f"videos/{_EPISODE_CHUNK}/{{video_key}}/{_EPISODE}.mp4",
    f"depth/{_EPISODE_CHUNK}/{{camera}}/{_EPISODE}.mkv",
    one_file_per_episode=True,
)
LAYOUTS = {layout.codebase_version: layout for layout in (V3, V21)}
"""File layouts by ``codebase_version``."""

Version = Literal["0.6", "0.5", "2.1"]  # a literal for the command line and type checkers


@dataclass(frozen=True)
class Variant:
    """Features that are written for a LeRobot version.

    Attributes:
        language: sub-goals, paraphrases and boxes are language columns; otherwise sub-goals are ``subtask_index``.
        native_depth: depth is a video feature of LeRobot; otherwise an FFV1 video that LeRobot ignores.
        outcome: there are ``next.reward``, ``next.success`` and ``next.done``.
    """

    version: Version
    layout: FileLayout
    language: bool = False
    native_depth: bool = False
    outcome: bool = False


VARIANTS: dict[str, Variant] = {
    variant.version: variant
    for variant in (
        Variant("0.6", V3, language=True, native_depth=True, outcome=True),
        Variant("0.5", V3),
        Variant("2.1", V21, outcome=True),
    )
}
NEWEST: Version = get_args(Version)[0]


def find_variant(version: str) -> Variant:
    """Return the variant of a LeRobot version; raise DatasetError if it is unknown."""
    if version not in VARIANTS:
        what, known = "unknown LeRobot version", ", ".join(VARIANTS)
        raise DatasetError(what, where="--lerobot-version", expected=known, found=version)
    return VARIANTS[version]
