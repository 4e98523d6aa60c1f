"""Surveys a dataset in the format of RoboCAS-v0: which episodes can be imported, and what is wrong with the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.pictures import SOUND, SURPLUS, Sizes, check_camera_file, check_images
from robocas_ms3.datasets.checks.violation import NO_FILE, Violation
from robocas_ms3.datasets.manage.repairs import (
    EMBEDDINGS,
    Finding,
    Outcome,
    eef_turn,
    finding,
    key_findings,
    repair_arrays,
    turn_eef_frame,
)
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.files import said_of
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.tolerant import EpisodeArrays, arrays_fingerprint, completed, load_arrays
from robocas_ms3.robots.cameras import EE_CAMERA

_FULL_SIZE = (640, 480)
_SHOWN_IMAGES = 3  # findings per folder of images


@dataclass(frozen=True)
class ImportedEpisode:
    """An episode with its repaired arrays.

    Attributes:
        number: of the episode.
        stored: its arrays.
        findings: what is or was wrong.
        turn_deg: angle about z by which its EEF frame was turned.
        pictures: its images; None if they were not checked.
    """

    number: int
    stored: EpisodeArrays
    findings: tuple[Finding, ...]
    turn_deg: int = 0
    pictures: Pictures | None = None

    @property
    def usable(self) -> bool:
        """Whether it can be imported."""
        return all(found.outcome != "left out" for found in self.findings)

    @property
    def embedded(self) -> bool:
        """Whether all embeddings are there."""
        return set(EMBEDDINGS) <= self.stored.arrays.keys()

    def extended(self, findings: Sequence[Finding], **changes: Any) -> ImportedEpisode:
        """Return it with further findings and other values."""
        return replace(self, findings=(*self.findings, *findings), **changes)


@dataclass
class Survey:
    """Result of a survey.

    Attributes:
        root: folder of the dataset.
        rate_hz: steps per second.
        turn_eef: whether turned EEF frames are turned back.
        episodes: number of episodes.
        taken: number -> T of the episodes that can be imported.
        pictures: their images; None if there are none.
        embeddings: whether all of them have embeddings.
        findings: of all episodes.
    """

    root: Path
    rate_hz: float
    turn_eef: bool
    episodes: int
    taken: dict[int, int]
    pictures: Pictures | None
    embeddings: bool
    findings: list[Finding]

    @property
    def left_out(self) -> list[int]:
        """Numbers of the episodes that can't be imported."""
        return sorted({f.episode for f in self.findings if f.outcome == "left out" and f.episode is not None})

    def as_json(self) -> dict[str, Any]:
        """Return the report."""
        return {
            "dataset": self.root.resolve().name,
            "rate_hz": self.rate_hz,
            "episodes": self.episodes,
            "taken": len(self.taken),
            "steps": sum(self.taken.values()),
            "left_out": self.left_out,
            "pictures": asdict(self.pictures) if self.pictures else None,
            "embeddings": self.embeddings,
            "findings": [asdict(found) for found in self.findings],
        }


def survey(
    root: Path,
    *,
    rate_hz: float | None = None,
    turn_eef: bool = True,
    on_episode: Callable[[int, int], None] | None = None,
) -> Survey:
    """Check each episode: arrays, cameras, and header and checksums of each image.

    Args:
        root: folder of the dataset.
        rate_hz: steps per second; None: as in ``conversion.json``, 5 without one.
        turn_eef: turn the EEF frame to ManiSkill's TCP if the pose of the gripper camera shows that it is turned.
        on_episode: called with (done, all) after each episode.

    Raises:
        DatasetError: there are no episodes, or the rate is not positive.
    """
    dataset = Dataset(root)
    rate_hz = dataset.rate_hz if rate_hz is None else rate_hz
    if rate_hz <= 0:
        raise DatasetError("no such rate", where="rate", expected="> 0 Hz", found=rate_hz)
    info, findings = read_info(dataset)
    usable: dict[int, ImportedEpisode] = {}
    fingerprints: dict[int, str] = {}
    for done, number in enumerate(dataset.numbers, start=1):
        read = read_episode(dataset, number, info, rate_hz, turn_eef)
        if read.usable:
            read = _check_images(read, dataset.episode(number))
        findings += read.findings
        if read.usable:
            fingerprints[number] = arrays_fingerprint(read.stored.arrays)
            usable[number] = replace(read, stored=replace(read.stored, arrays=_few(read.stored)))
        if on_episode:
            on_episode(done, len(dataset.numbers))
    most = Counter(read.pictures for read in usable.values()).most_common(1)[0][0] if usable else None
    first: dict[str, int] = {}
    taken: dict[int, int] = {}
    for number, read in usable.items():
        if read.pictures != most:
            text = f"pictures of {_describe(read.pictures)}; most are of {_describe(most)}"
        elif first.setdefault(fingerprints[number], number) != number:
            text = f"the same as episode {first[fingerprints[number]]}"
        else:
            taken[number] = read.stored.steps
            continue
        findings.append(Finding(number, schema.episode_folder(number), text, "left out"))
    lacking = [number for number in taken if not usable[number].embedded]
    if lacking and len(lacking) < len(taken):
        text = f"missing in {count_of(len(lacking), 'episode')}: those of the others are not taken"
        findings.append(Finding(None, f"{schema.EPISODE_FILE}, embeddings", text, "mended"))
    findings += _missing_files(dataset, list(taken), rate_hz)
    findings.sort(key=lambda found: -1 if found.episode is None else found.episode)
    embeddings = bool(taken) and not lacking
    return Survey(root, rate_hz, turn_eef, len(dataset.numbers), taken, most, embeddings, findings)


def _few(stored: EpisodeArrays) -> dict[str, Any]:
    """Return what a survey keeps of the arrays of each episode: length, and which embeddings there are."""
    kept = {key: stored.arrays[key][:0] for key in EMBEDDINGS if key in stored.arrays}
    return {"ee_pos": stored.arrays["ee_pos"], **kept}


def read_episode(
    dataset: Dataset, number: int, info: Mapping[str, Any], rate_hz: float, turn_eef: bool
) -> ImportedEpisode:
    """Read and repair the arrays of an episode, and check its cameras.

    Args:
        dataset: it is in.
        number: of the episode.
        info: ``data_info.json``.
        rate_hz, turn_eef: see `survey`.
    """
    episode, said = dataset.episode(number), said_of(info, number)
    name, path = episode.folder.name, episode.folder / schema.EPISODE_FILE
    try:
        loaded = load_arrays(path)
    except DatasetError as error:
        damaged = Finding(number, f"{name}/{schema.EPISODE_FILE}", _reason(error), "left out")
        return ImportedEpisode(number, EpisodeArrays(path, {}), (damaged,))
    stored = completed(loaded, said, rate_hz)
    read = ImportedEpisode(number, stored, tuple(key_findings(loaded, stored)))
    if read.usable:
        stored, found = repair_arrays(stored)
        for key, value in (("ep_length", stored.steps), ("language_goal", str(stored.arrays["language_goal"]))):
            if said.get(key, value) != value:
                text = f"{schema.DATA_INFO_FILE} says {said[key]!r}, this {value!r}"
                found.append(finding(stored, key, "mended", text))
        read = read.extended(found, stored=stored)
    if read.usable:
        cameras = [Finding(number, f"{name}/{file}", text, "left out") for file, text in _check_cameras(episode)]
        read = read.extended(cameras)
    if read.usable and turn_eef and EE_CAMERA in episode.cameras and not episode.scene.get("env_info"):
        turn = eef_turn(episode.camera_in_parent(EE_CAMERA))
        if turn:
            text = f"EEF frame turned by {turn} degrees about z, to be ManiSkill's TCP"
            found = finding(read.stored, "ee_orn, rel_pos, rel_orn", "mended", text)
            read = read.extended([found], stored=turn_eef_frame(read.stored, turn), turn_deg=turn)
    return read


def _reason(error: DatasetError) -> str:
    return f"{error.what}{f': {error.found}' if error.found else ''}"


def _check_cameras(episode: Episode) -> Iterator[tuple[str, str]]:
    """Yield file and fault of cameras that can't be used."""
    if not episode.cameras:
        yield "", "no cameras"
    for camera in episode.cameras:
        try:
            intrinsic, pose = episode.intrinsic(camera), episode.camera_in_parent(camera)
        except DatasetError as error:
            yield camera, _reason(error)
            continue
        for wrong in check_camera_file(f"{camera}/{schema.INTRINSIC_FILE}", intrinsic.astype(np.float64), pose=False):
            yield wrong.file, f"not {wrong.expected}: {wrong.found}"
        for wrong in check_camera_file(camera, pose.astype(np.float64), pose=True):
            yield wrong.file, f"its pose is not {wrong.expected}"


def _check_images(read: ImportedEpisode, episode: Episode) -> ImportedEpisode:
    """Check the images of an episode; a few findings per folder are listed."""
    name, number, steps = episode.folder.name, read.number, read.stored.steps
    pictures = Pictures(episode.cameras, None, episode.has_depth, episode.image_format)
    sizes: Sizes = {}
    by_folder: dict[str, list[Violation]] = {}
    for wrong in check_images(episode.folder, pictures, steps, sizes):
        by_folder.setdefault(wrong.file.rpartition("/")[0], []).append(wrong)
    findings: list[Finding] = []
    for folder, found in by_folder.items():
        wrong = [violation for violation in found if violation.found != SURPLUS]
        findings += [Finding(number, v.file, _image_fault(v), "left out") for v in wrong[:_SHOWN_IMAGES]]
        if len(wrong) > _SHOWN_IMAGES:
            text = f"{len(wrong) - _SHOWN_IMAGES} more are missing or damaged"
            findings.append(Finding(number, folder, text, "left out"))
        if len(found) > len(wrong):
            text = f"{count_of(len(found) - len(wrong), 'file')} beyond the {count_of(steps, 'step')}: not taken"
            findings.append(Finding(number, folder, text, "noted"))
    different = set(sizes.values())
    size = None if len(different) != 1 or _FULL_SIZE in different else different.pop()
    try:
        return read.extended(findings, pictures=replace(pictures, size=size))
    except DatasetError as error:  # too small
        return read.extended([*findings, Finding(number, name, _reason(error), "left out")], pictures=pictures)


def _image_fault(wrong: Violation) -> str:
    if wrong.expected == SOUND:
        return wrong.found
    if wrong.found == NO_FILE:
        return "missing"
    pairs = zip(wrong.found.split(", "), wrong.expected.split(", "), strict=True)  # size, channels and bits
    found, expected = zip(*((a, b) for a, b in pairs if a != b), strict=True)
    return f"{', '.join(found)}, not {', '.join(expected)}"


def _describe(pictures: Pictures | None) -> str:
    assert pictures is not None
    size = "{} x {}".format(*(pictures.size or _FULL_SIZE))
    depth = "with" if pictures.depth else "without"
    return f"{', '.join(pictures.cameras)}, {size} {pictures.image_format}, {depth} depth"


def _missing_files(dataset: Dataset, taken: Sequence[int], rate_hz: float) -> Iterator[Finding]:
    """Yield files of today's schema that are missing, once if they are missing in all episodes that are taken."""
    if not dataset.settings:
        made = f"no file: made of the episodes, {rate_hz:g} steps a second"
        yield Finding(None, schema.CONVERSION_FILE, made, "mended")
    lacking: dict[tuple[str, str, Outcome], list[int]] = {}
    for number in taken:
        episode = dataset.episode(number)
        files: list[tuple[str, str, Outcome]] = [
            (schema.SCENE_FILE, "no file: seed, target, layout and configuration are not known", "noted")
        ]
        for camera in episode.cameras:
            names = schema.pose_files(episode.camera_parent(camera))
            for name, other in zip(names, names[::-1], strict=True):
                files.append((f"{camera}/{name}", f"no file: a copy of {other}", "mended"))
        for key in files:
            if not (episode.folder / key[0]).is_file():
                lacking.setdefault(key, []).append(number)
    for (file, problem, outcome), numbers in lacking.items():
        if len(numbers) == len(taken):
            yield Finding(None, file, problem, outcome)
        else:
            yield from (Finding(n, f"{schema.episode_folder(n)}/{file}", problem, outcome) for n in numbers)


def read_info(dataset: Dataset) -> tuple[dict[str, Any], list[Finding]]:
    """Return the usable content of ``data_info.json``, and what is wrong with it."""
    file = schema.DATA_INFO_FILE
    try:
        info = dataset.info
    except DatasetError as error:
        return {}, [Finding(None, file, f"damaged: {error.found}", "mended")]
    if not info:
        return {}, [Finding(None, file, "no file: made of the episodes, with a split of its own", "mended")]
    there, train, val = set(dataset.numbers), _numbers(info.get("train_eps")), _numbers(info.get("val_eps"))
    listed = Counter([*train, *val])
    lists = f"{file}, train_eps, val_eps"
    findings = [
        *(Finding(n, file, "listed, but there is no such folder", "mended") for n in sorted(set(listed) - there)),
        *(Finding(n, lists, "listed twice: it trains", "mended") for n in sorted(listed) if listed[n] > 1),
        *(Finding(n, lists, "not listed: added", "mended") for n in sorted(there - set(listed))),
    ]
    sides = {"train_eps": [n for n in train if n in there], "val_eps": [n for n in val if n in there - set(train)]}
    return {**info, **sides}, findings


def _numbers(values: Any) -> list[int]:
    values = values if isinstance(values, list) else []
    return [int(v) for v in values if isinstance(v, int) or (isinstance(v, str) and v.isdecimal())]
