"""Episodes to read, whatever they lie in: a trajectory file, a RoboCAS folder, a LeRobot folder, or another's format.

A source reads an overview when it is opened and everything else when it is asked for; it keeps no file open, so it may
be pickled and forked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.recordings.subgoals import SubGoal

Side = Literal["train", "val", "all"]
"""Of the split into training and validation."""


class SourceEpisode(Protocol):
    """What is known of an episode.

    Arrays are those of ``schema.EPISODE_INFO``, of its types and shapes; what else is read raises ``DatasetError``
    where it is missing or damaged.
    """

    @property
    def where(self) -> object:
        """What it lies in, for messages."""
        ...

    @property
    def steps(self) -> int:
        """T."""
        ...

    @property
    def arrays(self) -> dict[str, NDArray]:
        """All arrays that are there."""
        ...

    def read(self, keys: Sequence[str]) -> dict[str, NDArray]:
        """Some of the arrays, all of which have to be there."""
        ...

    @property
    def goals(self) -> list[SubGoal]:
        """Sub-goals over the steps; empty where they are not known."""
        ...

    @property
    def scene(self) -> dict[str, Any]:
        """How it was made, by the keys of ``schema.SCENE`` that are known; empty where none is."""
        ...

    @property
    def layout(self) -> dict[str, Any]:
        """What stood where at its beginning, as ``layout`` of ``schema.SCENE``; empty where it is not known."""
        ...

    @property
    def cameras(self) -> tuple[str, ...]:
        """That there are pictures of."""
        ...

    def rgb(self, camera: str, step: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        ...

    def depth(self, camera: str, step: int) -> NDArray[np.uint16]:
        """(H, W) mm, 0 = nothing."""
        ...

    def intrinsic(self, camera: str) -> NDArray[np.float64]:
        """(4,) fx, fy, cx, cy in pixels."""
        ...

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """(4, 4) OpenCV camera frame in its parent, see ``schema.CAMERAS``."""
        ...


class EpisodeSource(Protocol):
    """Episodes by number; what is read of them raises ``DatasetError`` where it is damaged.

    Attributes:
        root: the folder or file.
    """

    root: Path

    @property
    def rate_hz(self) -> float:
        """Steps a second."""
        ...

    @property
    def numbers(self) -> list[int]:
        """Of its episodes, sorted."""
        ...

    @property
    def lengths(self) -> Mapping[int, int]:
        """Number -> T, without opening the episodes."""
        ...

    @property
    def cameras(self) -> tuple[str, ...]:
        """That there are pictures of; empty where there are none."""
        ...

    @property
    def has_depth(self) -> bool:
        """Whether depth is there."""
        ...

    @property
    def has_embeddings(self) -> bool:
        """Whether embeddings of the texts are there."""
        ...

    def split(self, side: Side) -> list[int]:
        """Numbers of the episodes of one side."""
        ...

    def entry(self, number: int) -> Mapping[str, Any]:
        """Which recording an episode is of, see ``provenance.recording_entry``; empty where that is not known."""
        ...

    def action_space(self) -> dict[str, Any]:
        """Range of the motion, as in ``data_info.json``."""
        ...

    def episode(self, number: int) -> SourceEpisode:
        """Open an episode."""
        ...
