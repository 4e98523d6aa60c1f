"""Training samples of a trajectory file, which holds no pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from robocas_ms3.datasets.sources.arrays import episode_arrays
from robocas_ms3.datasets.sources.provenance import succeeded
from robocas_ms3.datasets.sources.reader import Episode
from robocas_ms3.datasets.writing.info import action_space, split_by_seed
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.motion import sample_states, sample_stride
from robocas_ms3.recordings.reading import TrajectoryFile
from robocas_ms3.recordings.subgoals import SubGoal, sample_subgoals

if TYPE_CHECKING:
    from robocas_ms3.datasets.formats import Split


class TrajectorySource:
    """A trajectory file of ``robocas generate``: its episodes as ``robocas convert`` would number and sample them.

    Raises:
        DatasetError: it can't be read, holds no (successful) episode, or the rate does not divide its frequency.
    """

    cameras: tuple[str, ...] = ()
    has_depth = False
    has_embeddings = False

    def __init__(self, path: Path, *, rate_hz: float = 5.0, include_failed: bool = False) -> None:
        self.path, self.rate_hz = path, rate_hz
        with TrajectoryFile(path) as file:
            self._stride = sample_stride(file.control_freq, rate_hz)
            self._index = [n for n, e in enumerate(file.episodes) if include_failed or succeeded(e)]
            self._entries = [file.entry(index) for index in self._index]
        self.lengths = {n: len(sample_states(e.control_steps, self._stride)) for n, e in enumerate(self._entries)}
        train, val = split_by_seed({n: entry.seed for n, entry in enumerate(self._entries)})
        self._split = {"train": train, "val": val, "all": list(self.lengths)}

    def split(self, side: Split) -> list[int]:
        """Numbers of the episodes of one side, by the rule of ``robocas convert``."""
        return self._split[side]

    def goals(self, number: int) -> list[SubGoal]:
        """Sub-goals of an episode, over the sampled steps."""
        entry = self._entries[number]
        return sample_subgoals(entry.subgoals, sample_states(entry.control_steps, self._stride))

    def arrays(self, number: int, keys: Sequence[str]) -> dict[str, NDArray]:
        """Compute an episode's arrays from its states, by forward kinematics.

        Raises:
            DatasetError: it is damaged, or the states are those of another robot.
        """
        with TrajectoryFile(self.path) as file:
            recording = file.recording(self._index[number], bodies=False)
        samples = sample_states(recording.control_steps, self._stride)
        made = episode_arrays(recording.motion(samples), recording.instruction, self.goals(number))
        missing = [key for key in keys if key not in made]
        if missing:
            raise DatasetError("a trajectory file does not hold this", where=self.path, found=", ".join(missing))
        return {key: made[key] for key in keys}

    def action_space(self) -> dict[str, Any]:
        """Percentiles over all episodes, which are read for it."""
        parts = [self.arrays(number, ("rel_pos", "rel_orn")) for number in self.lengths]
        return action_space([part["rel_pos"] for part in parts], [part["rel_orn"] for part in parts])

    def episode(self, number: int) -> Episode:
        """Not here.

        Raises:
            DatasetError: always.
        """
        raise DatasetError(
            "a trajectory file holds no pictures", where=self.path, fix="Convert it with robocas convert."
        )
