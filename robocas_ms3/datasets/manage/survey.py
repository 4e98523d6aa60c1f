"""Looks through a dataset made elsewhere: which episodes can be taken, how, and what is wrong with the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.manage.findings import Finding, Layout, Outcome
from robocas_ms3.datasets.manage.reading import read_episode
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint
from robocas_ms3.datasets.statistics.described import count_of
from robocas_ms3.errors import DatasetError


@dataclass
class Survey:
    """What was found.

    Attributes:
        root: the dataset.
        rate_hz: its steps a second.
        turn_eef: see `reading.read_episode`.
        episodes: how many there are.
        taken: number -> T of those that can be taken.
        layout: of their pictures; None where there are none.
        embeddings: whether all of them have embeddings.
        findings: everything worth telling.
    """

    root: Path
    rate_hz: float
    turn_eef: bool
    episodes: int
    taken: dict[int, int]
    layout: Layout | None
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
            "pictures": asdict(self.layout) if self.layout else None,
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
    findings: list[Finding] = []
    info = read_info(dataset, findings)
    layouts: dict[int, Layout] = {}
    lengths: dict[int, int] = {}
    embedded: set[int] = set()
    marks: dict[int, str] = {}
    for done, number in enumerate(dataset.numbers):
        found = read_episode(dataset, number, info, findings, rate_hz=rate_hz, turn_eef=turn_eef)
        if found is not None and found.layout is not None:
            lengths[number], layouts[number] = found.steps, found.layout
            marks[number] = arrays_fingerprint(found.arrays)
            embedded |= {number} if found.embedded else set()
        if on_episode:
            on_episode(done + 1, len(dataset.numbers))
    layout = Counter(layouts.values()).most_common(1)[0][0] if layouts else None
    for number, other in layouts.items():
        if other != layout:
            name = schema.episode_folder(number)
            findings.append(Finding(number, name, f"pictures of {other}; most are of {layout}", "left out"))
            del lengths[number]
    firsts: dict[str, int] = {}
    for number in list(lengths):  # of those that can be taken the first one is
        first = firsts.setdefault(marks[number], number)
        if first != number:
            name = schema.episode_folder(number)
            findings.append(Finding(number, name, f"the same as episode {first}", "left out"))
            del lengths[number]
    embeddings = bool(lengths) and embedded >= set(lengths)
    if not embeddings and embedded & set(lengths):
        lacking = f"missing in {count_of(len(set(lengths) - embedded), 'episode')}: those of the others are not taken"
        findings.append(Finding(None, f"{schema.EPISODE_FILE}, embeddings", lacking, "mended"))
    findings += _files(dataset, list(lengths), rate_hz)
    findings.sort(key=lambda finding: -1 if finding.episode is None else finding.episode)
    return Survey(root, rate_hz, turn_eef, len(dataset.numbers), lengths, layout, embeddings, findings)


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


def read_info(dataset: Dataset, findings: list[Finding]) -> dict[str, Any]:
    """``data_info.json`` as far as it can be read; what is wrong with it is added to the findings."""
    file = schema.DATA_INFO_FILE
    try:
        info = dataset.info
    except DatasetError as error:
        findings.append(Finding(None, file, f"damaged: {error.found}", "mended"))
        return {}
    if not info:
        findings.append(Finding(None, file, "no file: made of the episodes, with a split of its own", "mended"))
        return {}
    sides = {key: [n for n in _numbers(info.get(key)) if n in dataset.numbers] for key in ("train_eps", "val_eps")}
    listed = [n for key in ("train_eps", "val_eps") for n in _numbers(info.get(key))]
    for number in sorted(set(listed) - set(dataset.numbers)):
        findings.append(Finding(number, file, "listed, but there is no such folder", "mended"))
    for number in sorted({n for n in listed if listed.count(n) > 1}):
        findings.append(Finding(number, f"{file}, train_eps, val_eps", "listed twice: it trains", "mended"))
    unlisted = sorted(set(dataset.numbers) - set(listed))
    findings += [Finding(n, f"{file}, train_eps, val_eps", "not listed: added", "mended") for n in unlisted]
    sides["val_eps"] = [n for n in sides["val_eps"] if n not in set(sides["train_eps"])]
    return {**info, **sides}


def _numbers(values: Any) -> list[int]:
    values = values if isinstance(values, list) else []
    return [int(v) for v in values if isinstance(v, int) or (isinstance(v, str) and v.isdecimal())]
