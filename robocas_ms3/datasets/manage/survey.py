"""Survey of a dataset in the format of RoboCAS-v0: importable episodes and findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_count
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.images import Sizes, check_camera_array, check_images
from robocas_ms3.datasets.checks.violation import NO_FILE, Violation
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.manage.repairs import (
    EMBEDDINGS,
    Finding,
    ImportedEpisode,
    add_key_findings,
    find_eef_rotation,
    repair_arrays,
    rotate_eef_frame,
)
from robocas_ms3.datasets.sources.arrays import EpisodeArrays, derive_missing_arrays, fingerprint_arrays, load_arrays
from robocas_ms3.datasets.sources.files import episode_info
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.robots.cameras import EE_CAMERA

_FULL_SIZE = (640, 480)


@dataclass
class Survey:
    """Result of the check of a dataset before an import.

    Attributes:
        root: folder of the dataset.
        rate_hz: rate of the dataset in Hz.
        turn_eef: whether EEF frames were rotated to ManiSkill's TCP.
        episodes: number of episodes.
        importable: number of steps T of each importable episode, by number.
        image_options: cameras, size, depth and format of the images; None: no episode is importable.
        embeddings: whether all importable episodes have embeddings.
        findings: all violations, with their outcome.
    """

    root: Path
    rate_hz: float
    turn_eef: bool
    episodes: int
    importable: dict[int, int]
    image_options: ImageOptions | None
    embeddings: bool
    findings: list[Finding]

    @property
    def skipped(self) -> list[int]:
        return sorted({f.episode for f in self.findings if f.outcome == "skipped" and f.episode is not None})

    def as_json(self) -> dict[str, Any]:
        return {
            "dataset": self.root.resolve().name,
            "rate_hz": self.rate_hz,
            "episodes": self.episodes,
            "importable": len(self.importable),
            "steps": sum(self.importable.values()),
            "skipped": self.skipped,
            "images": asdict(self.image_options) if self.image_options else None,
            "embeddings": self.embeddings,
            "findings": [found.as_json() for found in self.findings],
        }


def survey_dataset(
    root: Path,
    *,
    rate_hz: float | None = None,
    turn_eef: bool = True,
    on_episode: Callable[[int, int], None] | None = None,
) -> Survey:
    """Check all episodes of a dataset before an import: arrays, cameras, and checksums of images.

    ``rate_hz``: default: the rate in ``conversion.json``, or 5 Hz without that file. ``turn_eef``: rotate the EEF frame
    to ManiSkill's TCP if the pose of the gripper camera shows a rotation. ``on_episode`` is called with (done, total)
    after each episode.

    Raises:
        DatasetError: there are no episodes, or the rate is not positive.
    """
    dataset = Dataset(root)
    rate_hz = dataset.rate_hz if rate_hz is None else rate_hz
    if rate_hz <= 0:
        raise DatasetError("invalid rate", where="--rate", expected="> 0 Hz", found=rate_hz)
    info, findings = read_data_info(dataset)
    if not dataset.settings:
        wrong = Violation(schema.CONVERSION_FILE, "", "this file", NO_FILE)
        findings.append(Finding(None, wrong, "repaired", f"derived from the episodes, {rate_hz:g} Hz"))
    usable: list[ImportedEpisode] = []
    fingerprints: dict[int, str] = {}
    for done, number in enumerate(dataset.numbers, start=1):
        episode = read_imported_episode(dataset, number, info, rate_hz, turn_eef)
        if episode.is_importable:
            _check_images(episode, dataset.episode(number))
        if episode.is_importable:
            fingerprints[number] = fingerprint_arrays(episode.stored.arrays)
            embeddings = {key: episode.stored.arrays[key][:0] for key in EMBEDDINGS if key in episode.stored.arrays}
            arrays = {"ee_pos": episode.stored.arrays["ee_pos"], **embeddings}  # to save memory
            episode.stored = replace(episode.stored, arrays=arrays)
            usable.append(episode)
        else:
            findings += episode.findings
        if on_episode:
            on_episode(done, len(dataset.numbers))
    most = Counter(episode.image_options for episode in usable).most_common(1)[0][0] if usable else None
    first: dict[str, int] = {}
    for episode in usable:
        name = schema.episode_folder(episode.number)
        if episode.image_options != most:
            wrong = Violation(
                name, "", f"{_describe_images(most)}, as in most episodes", _describe_images(episode.image_options)
            )
            episode.add_finding(wrong, "skipped")
        elif (other := first.setdefault(fingerprints[episode.number], episode.number)) != episode.number:
            episode.add_finding(Violation(name, "", "each episode once", f"the arrays of episode {other}"), "skipped")
        findings += episode.findings
    importable = {episode.number: episode for episode in usable if episode.is_importable}
    lacking = [number for number, episode in importable.items() if not episode.has_embeddings]
    if lacking and len(lacking) < len(importable):
        found = f"{format_count(len(lacking), 'episode')} without"
        wrong = Violation(schema.EPISODE_FILE, "embeddings", "in all episodes or in none", found)
        findings.append(Finding(None, wrong, "repaired", "not imported"))
    findings = sorted(_merge_findings(findings, importable), key=lambda f: -1 if f.episode is None else f.episode)
    lengths = {number: episode.stored.steps for number, episode in importable.items()}
    embedded = bool(importable) and not lacking
    return Survey(root, rate_hz, turn_eef, len(dataset.numbers), lengths, most, embedded, findings)


def _merge_findings(findings: Sequence[Finding], importable: Mapping[int, ImportedEpisode]) -> Iterator[Finding]:
    """Yield all findings; a finding that all importable episodes share is yielded once, for the dataset."""
    shared = Counter(_to_dataset_finding(found) for found in findings if found.episode in importable)
    for found in findings:
        count = shared.get(_to_dataset_finding(found), 0) if found.episode in importable else 0
        if count < len(importable) or count < 2:
            yield found
        elif found.episode == next(iter(importable)):
            yield _to_dataset_finding(found)


def _to_dataset_finding(found: Finding) -> Finding:
    folder = "" if found.episode is None else f"{schema.episode_folder(found.episode)}/"
    file = found.violation.file.removeprefix(folder)
    return replace(found, episode=None, violation=replace(found.violation, file=file))


def read_imported_episode(
    dataset: Dataset, number: int, info: Mapping[str, Any], rate_hz: float, turn_eef: bool
) -> ImportedEpisode:
    """Read and repair the arrays of an episode, and check its cameras; arguments as in `survey_dataset`.

    ``info`` is the content of ``data_info.json``.
    """
    source, listed = dataset.episode(number), episode_info(info, number)
    path = source.folder / schema.EPISODE_FILE
    episode = ImportedEpisode(number, EpisodeArrays(path, {}))
    try:
        loaded = load_arrays(path)
    except DatasetError as error:
        episode.add_finding(
            _make_read_violation(f"{source.folder.name}/{path.name}", "a numpy archive", error), "skipped"
        )
        return episode
    episode.stored = derive_missing_arrays(loaded, listed, rate_hz)
    add_key_findings(episode, loaded)
    repair_arrays(episode)
    if episode.is_importable:
        arrays, file = episode.stored.arrays, episode.stored.file
        for key, value in (("ep_length", episode.stored.steps), ("language_goal", str(arrays["language_goal"]))):
            if listed.get(key, value) != value:
                wrong = Violation(file, key, f"{listed[key]!r} ({schema.DATA_INFO_FILE})", repr(value))
                episode.add_finding(wrong, "repaired", "the array is used")
        _check_files(episode, source)
    if episode.is_importable and turn_eef and EE_CAMERA in source.cameras and not source.scene.get("env_info"):
        turn = find_eef_rotation(source.camera_in_parent(EE_CAMERA))
        if turn:
            rotate_eef_frame(episode, turn)
    return episode


def _make_read_violation(file: str, expected: str, error: DatasetError) -> Violation:
    return Violation(file, "", expected, f"{error.what}{f': {error.found}' if error.found else ''}")


def _check_files(episode: ImportedEpisode, source: Episode) -> None:
    """Add findings for invalid cameras, and for missing files of the current schema."""
    name = source.folder.name
    if not source.cameras:
        episode.add_finding(Violation(name, "", "cameras", "none"), "skipped")
    for camera in source.cameras:
        try:
            model = source.camera(camera)
        except DatasetError as error:
            episode.add_finding(_make_read_violation(f"{name}/{camera}", "intrinsics and a pose", error), "skipped")
            continue
        intrinsic = f"{name}/{camera}/{schema.INTRINSIC_FILE}"
        poses = {f"{name}/{camera}": model.camera_in_parent}
        if (source.folder / camera / schema.true_pose_file(model.parent)).is_file():
            poses[f"{name}/{camera}/{schema.true_pose_file(model.parent)}"] = model.true_camera_in_parent
        for wrong in (
            *check_camera_array(intrinsic, model.intrinsic.astype(np.float64), pose=False),
            *(
                wrong
                for file, pose in poses.items()
                for wrong in check_camera_array(file, pose.astype(np.float64), pose=True)
            ),
        ):
            episode.add_finding(wrong, "skipped")
        files = schema.pose_files(model.parent)
        for file, other in zip(files, files[::-1], strict=True):
            if not (source.folder / camera / file).is_file():
                wrong = Violation(f"{name}/{camera}/{file}", "", "this file", NO_FILE)
                episode.add_finding(wrong, "repaired", f"a copy of {other}")
    if not (source.folder / schema.SCENE_FILE).is_file():
        wrong = Violation(f"{name}/{schema.SCENE_FILE}", "", "this file", NO_FILE)
        episode.add_finding(wrong, "warning", "seed, target, layout and configuration are unknown")


def _check_images(episode: ImportedEpisode, source: Episode) -> None:
    """Check the images of an episode; add at most one finding per folder of images and kind of violation."""
    image_options = ImageOptions(source.cameras, None, source.has_depth, source.image_format)
    sizes: Sizes = {}
    folders: dict[tuple[str, bool], list[Violation]] = {}
    for wrong in check_images(source.folder, image_options, episode.stored.steps, sizes):
        folders.setdefault((wrong.file.rpartition("/")[0], wrong.kind == "unexpected"), []).append(wrong)
    for found in folders.values():
        more = f"and {len(found) - 1} more" if len(found) > 1 else ""
        episode.add_finding(found[0], "warning" if found[0].kind == "unexpected" else "skipped", more)
    different = set(sizes.values())
    size = None if len(different) != 1 or _FULL_SIZE in different else different.pop()
    try:
        episode.image_options = replace(image_options, size=size)
    except DatasetError as error:  # too small
        episode.add_finding(Violation(source.folder.name, "", str(error.expected), str(error.found)), "skipped")


def _describe_images(image_options: ImageOptions | None) -> str:
    assert image_options is not None
    size = "{} x {}".format(*(image_options.size or _FULL_SIZE))
    depth = "with" if image_options.depth else "without"
    return f"{', '.join(image_options.cameras)}, {size} {image_options.image_format}, {depth} depth"


def read_data_info(dataset: Dataset) -> tuple[dict[str, Any], list[Finding]]:
    """Read the valid content of ``data_info.json``; return it and the findings."""
    file = schema.DATA_INFO_FILE
    try:
        info = dataset.info
    except DatasetError as error:
        return {}, [
            Finding(None, Violation(file, "", "JSON", str(error.found)), "repaired", "derived from the episodes")
        ]
    if not info:
        repair = "derived from the episodes, split by seed"
        return {}, [Finding(None, Violation(file, "", "this file", NO_FILE), "repaired", repair)]
    on_disk, train, val = (
        set(dataset.numbers),
        _parse_numbers(info.get("train_eps")),
        _parse_numbers(info.get("val_eps")),
    )
    listed = Counter([*train, *val])
    wrong = [
        *((n, "the episodes on disk", "an episode without a folder", "removed") for n in sorted(set(listed) - on_disk)),
        *((n, "each episode once", "a repeated episode", "used for training") for n in sorted(listed) if listed[n] > 1),
        *((n, "the episodes on disk", "an unlisted episode", "added") for n in sorted(on_disk - set(listed))),
    ]
    findings = [
        Finding(n, Violation(file, "train_eps, val_eps", expected, found), "repaired", repair)
        for n, expected, found, repair in wrong
    ]
    split = {"train_eps": [n for n in train if n in on_disk], "val_eps": [n for n in val if n in on_disk - set(train)]}
    return {**info, **split}, findings


def _parse_numbers(values: Any) -> list[int]:
    values = values if isinstance(values, list) else []
    return [int(v) for v in values if isinstance(v, int) or (isinstance(v, str) and v.isdecimal())]
