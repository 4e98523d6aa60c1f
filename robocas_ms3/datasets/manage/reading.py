"""Reads an episode made elsewhere, and puts right what can be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.content import NO_FILE, SURPLUS, read_headers
from robocas_ms3.datasets.checks.pictures import check_camera_file, check_pictures, sizes_of
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.manage.eef import eef_turn, turned
from robocas_ms3.datasets.manage.findings import EpisodeImport, Finding
from robocas_ms3.datasets.manage.mends import finding, key_findings, mend_all
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.files import said_of
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.tolerant import EpisodeArrays, completed, load_arrays

FULL_SIZE = (640, 480)
_MOST = 3  # problems named of one camera's pictures


def read_episode(
    dataset: Dataset,
    number: int,
    info: Mapping[str, Any],
    *,
    rate_hz: float,
    turn_eef: bool,
    pictures: bool = True,
) -> EpisodeImport:
    """Read an episode, and put right what can be; what builds on something that can't is not looked at.

    Args:
        dataset: it is in.
        number: of it.
        info: ``data_info.json``.
        rate_hz: steps a second.
        turn_eef: where the gripper camera's place says that the EEF frame is turned by a multiple of 90 degrees about
            z, as upstream's is, turn it to ManiSkill's TCP.
        pictures: whether to look at the pictures.
    """
    episode, said = dataset.episode(number), said_of(info, number)
    name, path = episode.folder.name, episode.folder / schema.EPISODE_FILE
    try:
        loaded = load_arrays(path)
    except DatasetError as error:
        bad = Finding(number, f"{name}/{schema.EPISODE_FILE}", _words(error), "left out")
        return EpisodeImport(number, EpisodeArrays(path, {}), (bad,))
    made = completed(loaded, said, rate_hz)
    read = EpisodeImport(number, made, tuple(key_findings(loaded, made)))
    if read.usable:
        stored, found = mend_all(made)
        read = EpisodeImport(number, stored, (*read.findings, *found, *_contradictions(stored, said)))
    if read.usable:
        cameras = (Finding(number, f"{name}/{place}", text, "left out") for place, text in _cameras(episode))
        read = replace(read, findings=(*read.findings, *cameras))
    if read.usable and turn_eef and "gripper_camera" in episode.cameras:
        read = _turned(read, eef_turn(episode.camera_in_parent("gripper_camera")))
    if read.usable and pictures:
        found, there = _pictures(episode, number, read.stored.steps)
        read = replace(read, findings=(*read.findings, *found), pictures=there)
    return read


def _words(error: DatasetError) -> str:
    return f"{error.what}{f': {error.found}' if error.found else ''}"


def _contradictions(stored: EpisodeArrays, said: Mapping[str, Any]) -> Iterator[Finding]:
    """Where ``data_info.json`` says something else than the arrays; it is made anew."""
    for key, value in (("ep_length", stored.steps), ("language_goal", str(stored.arrays["language_goal"]))):
        if key in said and said[key] != value:
            yield finding(stored, key, "mended", f"{schema.DATA_INFO_FILE} says {said[key]!r}, this {value!r}")


def _cameras(episode: Episode) -> Iterator[tuple[str, str]]:
    """(path in the folder, problem) of cameras that can't be used."""
    if not episode.cameras:
        yield "", "no cameras"
    for camera in episode.cameras:
        try:
            intrinsic, pose = episode.intrinsic(camera), episode.camera_in_parent(camera)
        except DatasetError as error:
            yield camera, _words(error)
            continue
        for wrong in check_camera_file(f"{camera}/{schema.INTRINSIC_FILE}", intrinsic.astype(np.float64), pose=False):
            yield wrong.file, f"not {wrong.expected}: {wrong.found}"
        for wrong in check_camera_file(camera, pose.astype(np.float64), pose=True):
            yield wrong.file, f"its pose is not {wrong.expected}"


def _turned(read: EpisodeImport, turn_deg: int) -> EpisodeImport:
    if not turn_deg:
        return read
    text = f"EEF frame turned by {turn_deg} degrees about z, to be ManiSkill's TCP"
    found = finding(read.stored, "ee_orn, rel_pos, rel_orn", "mended", text)
    return replace(read, stored=turned(read.stored, turn_deg), findings=(*read.findings, found), turn_deg=turn_deg)


def _pictures(episode: Episode, number: int, steps: int) -> tuple[list[Finding], Pictures]:
    """What is wrong with the pictures, a few named of each camera's, and what they are."""
    name = episode.folder.name
    pictures = Pictures(episode.cameras, None, episode.has_depth, episode.image_format)
    headers = read_headers(episode.folder, pictures, steps)
    sizes = sizes_of(headers)
    findings: list[Finding] = []
    for place in headers:
        images = list(check_pictures({place: headers[place]}, name, pictures, sizes))
        wrong = [violation for violation in images if violation.found != SURPLUS]
        findings += [Finding(number, v.file, _picture_words(v), "left out") for v in wrong[:_MOST]]
        if len(wrong) > _MOST:
            text = f"{len(wrong) - _MOST} more are missing or damaged"
            findings.append(Finding(number, f"{name}/{place}", text, "left out"))
        if len(images) > len(wrong):
            text = f"{count_of(len(images) - len(wrong), 'file')} beyond the {count_of(steps, 'step')}: not taken"
            findings.append(Finding(number, f"{name}/{place}", text, "noted"))
    shared = set(sizes.values())
    size = None if len(shared) != 1 or FULL_SIZE in shared else shared.pop()
    try:
        return findings, replace(pictures, size=size)
    except DatasetError as error:  # too small
        return [*findings, Finding(number, name, _words(error), "left out")], pictures


def _picture_words(wrong: Violation) -> str:
    if wrong.expected == "a sound picture":
        return wrong.found
    if wrong.found == NO_FILE:
        return "missing"
    pairs = zip(wrong.found.split(", "), wrong.expected.split(", "), strict=True)  # size, channels and bits
    found, expected = zip(*((a, b) for a, b in pairs if a != b), strict=True)
    return f"{', '.join(found)}, not {', '.join(expected)}"
