"""Brings a dataset of an older schema version up to date, in place."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.convert import open_env
from robocas_ms3.datasets.manage.parts import check_whole, schema_version, shown
from robocas_ms3.datasets.pictures import Pictures
from robocas_ms3.datasets.plan import dataset_settings
from robocas_ms3.datasets.provenance import fingerprint, scene_record, task_of
from robocas_ms3.datasets.reader import Dataset, Episode
from robocas_ms3.datasets.workers import OpenSource
from robocas_ms3.datasets.writer import FrameSource
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import locked_folder, replacing, write_json
from robocas_ms3.recordings.motion import sample_states, sample_stride
from robocas_ms3.recordings.reading import Recording, TrajectoryFile

_SAME_JOINTS = 1e-4  # rad
_IN_SCENES = ("trajectory", "env_info", "control_freq")  # of version 1's conversion.json, in scene.json now
_SMALLEST = Pictures(cameras=("static_camera",), size=(16, 16), depth=False)
"""What is rendered while scenes are only described: nothing, but the environment wants a size."""


@dataclass(frozen=True)
class Upgraded:
    """What was done.

    Attributes:
        before: schema version it had.
        described: episodes whose ``scene.json`` was written.
        incomplete: episodes whose layout is not known: their trajectory was not given.
    """

    before: int
    described: list[int]
    incomplete: list[int]


@dataclass
class _Source:
    """A trajectory file, and what shows its scenes."""

    file: TrajectoryFile
    open_source: OpenSource
    shown: FrameSource | None = None
    control_mode: str = ""
    by_id: dict[int, int] = field(default_factory=dict)

    def scene(self, recording: Recording) -> dict[str, Any]:
        if self.shown is None or recording.control_mode != self.control_mode:
            self.close()
            self.shown = self.open_source(self.file.env, recording.control_mode, _SMALLEST)
            self.control_mode = recording.control_mode
        self.shown.load(recording)
        return self.shown.scene()

    def close(self) -> None:
        if self.shown is not None:
            self.shown.close()
            self.shown = None


def upgrade(
    root: Path,
    *,
    trajectories: Sequence[Path] = (),
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[int], None] | None = None,
    open_source: OpenSource = open_env,
) -> Upgraded:
    """Write ``scene.json`` into every episode, then ``conversion.json`` in the form of today.

    Killed at any moment, the same call goes on. A dataset of today whose episodes were described without their
    trajectory is completed by it.

    Args:
        root: the dataset, of version 1 or of today's.
        trajectories: the files it was converted from; without, what only they know is null.
        on_start: called with the number of episodes to describe.
        on_episode: called after each.
        open_source: what rebuilds the scenes.

    Raises:
        DatasetError: there is no dataset, it is upstream's or of a newer version, unfinished, or not of these files.
    """
    _check_names(trajectories)
    with ExitStack() as stack:
        stack.enter_context(locked_folder(root))
        dataset = Dataset(root)
        version = _version(dataset)
        if not trajectories:
            check_whole(dataset)
        sources: dict[str, _Source] = {}
        for path in trajectories:
            source = _Source(stack.enter_context(TrajectoryFile(path)), open_source)
            stack.callback(source.close)
            source.by_id = {episode["episode_id"]: index for index, episode in enumerate(source.file.episodes)}
            sources[source.file.path.name] = source
        settings = _settings(dataset)
        ledger = _ledger(dataset, sources)
        todo = [n for n in dataset.numbers if _needs(dataset.episode(n), ledger[str(n)], sources)]
        if on_start:
            on_start(len(todo))
        for number in todo:
            episode = dataset.episode(number)
            record = _record(dataset, episode, ledger[str(number)], sources)
            with replacing(episode.folder / schema.SCENE_FILE) as tmp:
                tmp.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            if on_episode:
                on_episode(number)
        content = _content(dataset.settings, settings, ledger)
        if content != dataset.settings:
            write_json(root / schema.CONVERSION_FILE, content)  # last: until then the dataset is of the old version
    lacking = [n for n in dataset.numbers if dataset.episode(n).scene.get("layout") is None]
    return Upgraded(version, todo, lacking)


def _check_names(trajectories: Sequence[Path]) -> None:
    """Datasets say of which file an episode is by its name alone."""
    names = Counter(path.name for path in trajectories)
    twice = [path for path in trajectories if names[path.name] > 1]
    if twice:
        raise DatasetError(
            "trajectories of one name can't be told apart",
            where=", ".join(map(str, twice)),
            fix="Upgrade with one of them at a time, each dataset before it is merged.",
        )


def _version(dataset: Dataset) -> int:
    version = schema_version(dataset)
    if version == 0:
        fix = "Run robocas import-robocas."
        raise DatasetError("a dataset made elsewhere", where=dataset.root, found="no conversion.json", fix=fix)
    if version > schema.SCHEMA_VERSION:
        expected = f"<= {schema.SCHEMA_VERSION}"
        raise DatasetError("a dataset of a newer version", where=dataset.root, expected=expected, found=version)
    return version


def _content(before: Mapping[str, Any], settings: Mapping[str, Any], ledger: Mapping[str, Any]) -> dict[str, Any]:
    made_with = {key: value for key, value in before.get("made_with", {}).items() if key != "trajectory"}
    header = {"format": "robocas", "schema_version": schema.SCHEMA_VERSION, "made_with": made_with, **settings}
    others = {key: value for key, value in before.items() if key not in {*header, *_IN_SCENES, "episodes"}}
    return {**header, **others, "episodes": ledger}


def _settings(dataset: Dataset) -> dict[str, Any]:
    before, episode = dataset.settings, dataset.episode(dataset.numbers[0])
    size = before.get("image_size")
    pictures = Pictures(
        tuple(before.get("cameras", episode.cameras)),
        tuple(size) if size else None,
        before.get("depth", episode.has_depth),
        before.get("image_format", episode.image_format),
    )
    embeddings = before.get("embeddings", "language_embedding" in episode.arrays)
    return dataset_settings(dataset.rate_hz, pictures, embeddings)


def _ledger(dataset: Dataset, sources: Mapping[str, _Source]) -> dict[str, Any]:
    before = dataset.settings
    entries = before.get("episodes", {})
    unlisted = [number for number in dataset.numbers if str(number) not in entries]
    if unlisted:
        where = dataset.root / schema.CONVERSION_FILE
        raise DatasetError("these episodes are not listed", where=where, found=shown(unlisted))
    ledger = {}
    for number, entry in entries.items():
        name = entry.get("trajectory", before.get("trajectory"))
        known = {"trajectory": name, "trajectory_episode": None, "seed": None, "success": None, "target": None}
        ledger[number] = {**known, "recording": None, **entry}
        if ledger[number]["recording"] is None and name in sources:
            recording = _recording(ledger[number], sources[name], dataset.root)
            ledger[number]["recording"] = fingerprint(recording)
    return ledger


def _needs(episode: Episode, entry: Mapping[str, Any], sources: Mapping[str, _Source]) -> bool:
    scene = episode.scene
    if scene.get("schema_version") != schema.SCHEMA_VERSION:
        return True
    return scene.get("layout") is None and entry["trajectory"] in sources


def _record(
    dataset: Dataset, episode: Episode, entry: Mapping[str, Any], sources: Mapping[str, _Source]
) -> dict[str, Any]:
    source = sources.get(entry["trajectory"])
    if source is None:
        return _as_far_as_known(dataset, entry)
    recording = _recording(entry, source, dataset.root)
    stride = sample_stride(source.file.control_freq, dataset.rate_hz)
    samples = sample_states(recording.control_steps, stride)
    joints = recording.motion(samples).qpos[:, 3:10]
    found = episode.arrays.get("robot_joints")
    if found is None or found.shape != joints.shape or not np.abs(found - joints).max() <= _SAME_JOINTS:  # NaN too
        raise DatasetError(
            "this episode is not of that trajectory",
            where=episode.folder,
            expected=f"the joints of episode {recording.episode_id} of {source.file.path}",
            found="others",
        )
    index = source.by_id[recording.episode_id]
    return scene_record(source.file, index, recording, source.scene(recording), dataset.rate_hz)


def _recording(entry: Mapping[str, Any], source: _Source, root: Path) -> Recording:
    index = source.by_id.get(entry["trajectory_episode"])
    if index is None:
        raise DatasetError(
            "no such episode in this trajectory",
            where=source.file.path,
            expected=f"episode {entry['trajectory_episode']} of {root / schema.CONVERSION_FILE}",
            found=f"{len(source.by_id)} others",
        )
    return source.file.recording(index)


def _as_far_as_known(dataset: Dataset, entry: Mapping[str, Any]) -> dict[str, Any]:
    """``scene.json`` by what version 1 wrote down."""
    before = dataset.settings
    env_info = before.get("env_info") or {}
    known = {
        "schema_version": schema.SCHEMA_VERSION,
        "task": task_of(env_info.get("env_id")),
        "env_info": {key: env_info.get(key) for key in ("env_id", "env_kwargs")} if env_info else None,
        "seed": entry["seed"],
        "target": entry["target"],
        "success": entry["success"],
        "control_mode": env_info.get("env_kwargs", {}).get("control_mode"),
        "control_freq": before.get("control_freq"),
        "rate_hz": dataset.rate_hz,
        "source": {
            "trajectory": entry["trajectory"],
            "episode_id": entry["trajectory_episode"],
            "recording": entry["recording"],
        },
        "versions": before.get("made_with", {}).get("trajectory"),
    }
    return {key: known.get(key) for key in schema.SCENE}
