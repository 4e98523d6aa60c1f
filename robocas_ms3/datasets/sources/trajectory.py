"""Episode source for trajectory files of ``robocas generate``; it has states and no images."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robocas_ms3.assets.pack import find_packs, load_pack
from robocas_ms3.core.errors import AssetError, DatasetError, RobocasError
from robocas_ms3.datasets.sources.arrays import make_episode_arrays
from robocas_ms3.datasets.sources.episode_source import EpisodeSource, SourceEpisode, Split
from robocas_ms3.datasets.sources.provenance import make_recorded_scene, make_recording_entry, was_successful
from robocas_ms3.datasets.sources.reader import DEFAULT_RATE
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.recordings.motion import sample_states, sample_stride
from robocas_ms3.demos.recordings.subgoals import SubGoal, sample_subgoals
from robocas_ms3.demos.recordings.trajectory_file import Recording, TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_json import EpisodeEntry
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.layout import PARKING_HEIGHT


class TrajectorySource(EpisodeSource):
    """Trajectory file as an episode source.

    Numbers and steps of the episodes are those of a dataset that ``robocas convert`` writes.

    Attributes:
        file: metadata of the trajectory file; its HDF5 file is closed.
        stride: number of control steps per dataset step.
        index: position in the trajectory file of each episode.
    """

    cameras: tuple[str, ...] = ()
    has_depth = False

    def __init__(
        self,
        path: Path,
        *,
        rate_hz: float | None = None,
        include_failed: bool = False,
        pack: str | Path | None = None,
    ) -> None:
        self.root, self.rate_hz = path, float(DEFAULT_RATE if rate_hz is None else rate_hz)
        with TrajectoryFile(path, pack=pack) as file:
            self.stride = sample_stride(file.control_freq, self.rate_hz)
            self.index = [n for n, e in enumerate(file.episodes) if include_failed or was_successful(e)]
            self._entries = [_read_entry(file, index) for index in self.index]
        self.numbers, self.file = list(range(len(self.index))), file

    def episode_entry(self, number: int) -> EpisodeEntry:
        """Return the validated JSON entry of an episode."""
        found = self._entries[number]
        if isinstance(found, DatasetError):
            raise found
        return found

    def object_ids(self, number: int) -> list[Any]:
        """Return the object id in each slot of the scene of an episode."""
        return list(self.file.episodes[self.index[number]]["robocas"].get("objects") or ())

    def count_steps(self, number: int) -> int:
        """Return the number of dataset steps T of an episode."""
        return len(sample_states(self.episode_entry(number).control_steps, self.stride))

    @cached_property
    def lengths(self) -> dict[int, int]:
        return {number: self.count_steps(number) for number in self.numbers}

    def split(self, name: Split) -> list[int]:
        if name == "all":
            return self.numbers
        return split_by_seed({number: self.episode_entry(number).seed for number in self.numbers})[name == "val"]

    def conversion_entry(self, number: int) -> Mapping[str, Any]:
        with self.file.reopen() as file:
            return make_recording_entry(file, self.index[number])

    def recording(self, number: int, *, bodies: bool = True) -> Recording:
        """Read the recording of an episode; ``bodies`` False: only the states of the robot."""
        with self.file.reopen() as file:
            return file.read_recording(self.index[number], bodies=bodies)

    def episode(self, number: int) -> RecordedEpisode:
        if not 0 <= number < len(self.index):
            expected = f"0 to {len(self.index) - 1}"
            raise DatasetError("no such episode", where=self.root, expected=expected, found=number, usage=True)
        return RecordedEpisode(self, number)


class RecordedEpisode(SourceEpisode):
    """Episode of a `TrajectorySource`; arrays are computed from the states by forward kinematics."""

    cameras = ()

    def __init__(self, source: TrajectorySource, number: int) -> None:
        self._source, self._number = source, number

    @property
    def _entry(self) -> EpisodeEntry:
        return self._source.episode_entry(self._number)

    @property
    def where(self) -> str:
        return f"{self._source.root}, traj_{self._entry.episode_id}"

    @property
    def steps(self) -> int:
        return self._source.count_steps(self._number)

    @property
    def instruction(self) -> str:
        return self._entry.instruction

    @cached_property
    def arrays(self) -> dict[str, NDArray]:
        recording = self.recording(bodies=False)
        samples = sample_states(recording.control_steps, self._source.stride)
        return make_episode_arrays(recording.compute_motion(samples), recording.instruction, self.goals)

    @property
    def goals(self) -> list[SubGoal]:
        samples = sample_states(self._entry.control_steps, self._source.stride)
        return sample_subgoals(self._entry.subgoals, samples)

    @property
    def scene(self) -> dict[str, Any]:
        """Content of ``scene.json`` as far as the trajectory file has it.

        Object names are known only if the pack is installed.
        """
        source = self._source
        scene = make_recorded_scene(source.file, source.index[self._number])
        kwargs = scene["env_info"]["env_kwargs"]
        config, names = kwargs.get("config"), _load_object_names(str(kwargs.get("pack", "builtin")))
        objects = [
            {"slot": slot, "id": asset, "name": names[asset]}
            for slot, asset in enumerate(source.object_ids(self._number))
            if isinstance(asset, str) and asset in names
        ]
        config = config if isinstance(config, Mapping) else _load_bundled_config(str(config))
        return {**scene, "config": config, "objects": objects}

    @cached_property
    def layout(self) -> dict[str, Any]:
        ids = self._source.object_ids(self._number)
        actors = self.recording().states.get("actors", {})
        poses = [actors[f"object_{slot}"][0, :7] if f"object_{slot}" in actors else None for slot in range(len(ids))]
        there = [pose is not None and bool(pose[2] > PARKING_HEIGHT / 2) for pose in poses]
        known = [[0.0] * 7 if pose is None else pose.tolist() for pose in poses]
        return {"object_ids": ids, "poses": known, "present": there}

    def recording(self, *, bodies: bool = True) -> Recording:
        return self._source.recording(self._number, bodies=bodies)


def _read_entry(file: TrajectoryFile, index: int) -> EpisodeEntry | DatasetError:
    """Return the JSON entry of an episode, or the error to raise when the episode is read."""
    try:
        entry = file.read_entry(index)
        make_recorded_scene(file, index)
        return entry
    except DatasetError as error:
        return error


@cache
def _load_object_names(pack: str) -> dict[str, str]:
    """Load the object names of an installed pack, by object id; empty for paths and unknown packs."""
    try:
        return {asset: of.asset.name for asset, of in load_pack(pack).objects.items()} if pack in find_packs() else {}
    except AssetError:
        return {}


@cache
def _load_bundled_config(name: str) -> Mapping[str, Any]:
    """Load a bundled task configuration by name; empty if it does not exist."""
    try:
        return load_task_config(name).model_dump(mode="json")
    except RobocasError:
        return {}
