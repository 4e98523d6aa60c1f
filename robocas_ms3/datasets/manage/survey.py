"""Looks through a dataset made elsewhere: which episodes can be taken, how, and what is wrong with the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.manage.findings import Finding, Outcome
from robocas_ms3.datasets.manage.reading import FULL_SIZE, read_episode
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint


@dataclass
class Survey:
    """What was found.

    Attributes:
        root: the dataset.
        rate_hz: its steps a second.
        turn_eef: see `reading.read_episode`.
        episodes: how many there are.
        taken: number -> T of those that can be taken.
        pictures: that they have; None where there are none.
        embeddings: whether all of them have embeddings.
        findings: everything worth telling.
    """

    root: Path
    rate_hz: float
    turn_eef: bool
    episodes: int
    taken: dict[int, int]
    pictures: Pictures | None
    embeddings: bool
    findings: list[Finding]

    def as_json(self) -> dict[str, Any]:
        """The report."""
        left_out = sorted({f.episode for f in self.findings if f.outcome == "left out" and f.episode is not None})
        return {
            "dataset": self.root.resolve().name,
            "rate_hz": self.rate_hz,
            "episodes": self.episodes,
            "taken": len(self.taken),
            "steps": sum(self.taken.values()),
            "left_out": left_out,
            "pictures": asdict(self.pictures) if self.pictures else None,
            "embeddings": self.embeddings,
            "findings": [asdict(finding) for finding in self.findings],
        }


def survey(
    root: Path,
    *,
    rate_hz: float | None = None,
    turn_eef: bool = True,
    on_episode: Callable[[int, int], None] | None = None,
) -> Survey:
    """Look at every episode: arrays, cameras, and each picture's header and checksums.

    Args:
        root: the dataset.
        rate_hz: its steps a second; default: by ``conversion.json``, 5 where there is none.
        turn_eef: see `reading.read_episode`.
        on_episode: called with (done, all) after each.

    Raises:
        DatasetError: there are no episodes, or no such rate.
    """
    dataset = Dataset(root)
    rate_hz = dataset.rate_hz if rate_hz is None else rate_hz
    if rate_hz <= 0:
        raise DatasetError("no such rate", where="rate", expected="> 0 Hz", found=rate_hz)
    info, findings = read_info(dataset)
    pictures: dict[int, Pictures] = {}
    lengths: dict[int, int] = {}
    embedded: set[int] = set()
    marks: dict[int, str] = {}
    for done, number in enumerate(dataset.numbers):
        read = read_episode(dataset, number, info, rate_hz=rate_hz, turn_eef=turn_eef)
        findings += read.findings
        if read.usable and read.pictures is not None:
            lengths[number], pictures[number] = read.stored.steps, read.pictures
            marks[number] = arrays_fingerprint(read.stored.arrays)
            embedded |= {number} if read.embedded else set()
        if on_episode:
            on_episode(done + 1, len(dataset.numbers))
    most = Counter(pictures.values()).most_common(1)[0][0] if pictures else None
    for number, other in pictures.items():
        if most is not None and other != most:
            text = f"pictures of {_in_words(other)}; most are of {_in_words(most)}"
            findings.append(Finding(number, schema.episode_folder(number), text, "left out"))
            del lengths[number]
    firsts: dict[str, int] = {}
    for number in list(lengths):  # of those that can be taken the first one is
        first = firsts.setdefault(marks[number], number)
        if first != number:
            text = f"the same as episode {first}"
            findings.append(Finding(number, schema.episode_folder(number), text, "left out"))
            del lengths[number]
    embeddings = bool(lengths) and embedded >= set(lengths)
    if not embeddings and embedded & set(lengths):
        lacking = f"missing in {count_of(len(set(lengths) - embedded), 'episode')}: those of the others are not taken"
        findings.append(Finding(None, f"{schema.EPISODE_FILE}, embeddings", lacking, "mended"))
    findings += _files(dataset, list(lengths), rate_hz)
    findings.sort(key=lambda finding: -1 if finding.episode is None else finding.episode)
    return Survey(root, rate_hz, turn_eef, len(dataset.numbers), lengths, most, embeddings, findings)


def _in_words(pictures: Pictures) -> str:
    size = "{} x {}".format(*(pictures.size or FULL_SIZE))
    depth = "with" if pictures.depth else "without"
    return f"{', '.join(pictures.cameras)}, {size} {pictures.image_format}, {depth} depth"


def _files(dataset: Dataset, taken: Sequence[int], rate_hz: float) -> Iterator[Finding]:
    """Files of today's schema that are missing; told once where they are in all episodes that can be taken."""
    if not dataset.settings:
        made = f"no file: made of the episodes, {rate_hz:g} steps a second"
        yield Finding(None, schema.CONVERSION_FILE, made, "mended")
    lacking: dict[tuple[str, str, Outcome], list[int]] = {}
    for number in taken:
        episode = dataset.episode(number)
        if not (episode.folder / schema.SCENE_FILE).is_file():
            text = "no file: seed, target, layout and configuration are not known"
            lacking.setdefault((schema.SCENE_FILE, text, "noted"), []).append(number)
        for camera in [camera for camera in schema.CAMERAS if camera.name in episode.cameras]:
            for name, other in zip(camera.pose_files, camera.pose_files[::-1], strict=True):
                if not (episode.folder / camera.name / name).is_file():
                    key: tuple[str, str, Outcome] = (f"{camera.name}/{name}", f"no file: a copy of {other}", "mended")
                    lacking.setdefault(key, []).append(number)
    for (file, problem, outcome), numbers in lacking.items():
        if len(numbers) == len(taken):
            yield Finding(None, file, problem, outcome)
        else:
            yield from (Finding(n, f"{schema.episode_folder(n)}/{file}", problem, outcome) for n in numbers)


def read_info(dataset: Dataset) -> tuple[dict[str, Any], list[Finding]]:
    """``data_info.json`` as far as it can be used, and what is wrong with it."""
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
