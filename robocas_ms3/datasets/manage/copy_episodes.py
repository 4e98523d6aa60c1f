"""Copy episodes of finished datasets into new datasets, for merging and splitting."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import robocas_ms3
from robocas_ms3.core.documents import check_regular_file
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_folder
from robocas_ms3.core.output_folder import OutputFolder
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import format_count, format_ranges
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as array_checks
from robocas_ms3.datasets.checks.images import check_cameras, check_images
from robocas_ms3.datasets.checks.scene import read_settings
from robocas_ms3.datasets.checks.violation import Violation, read_json_object
from robocas_ms3.datasets.conversion.data_info import write_data_info
from robocas_ms3.datasets.conversion.episode_plan import DATASET, SETTINGS_KEYS, make_header
from robocas_ms3.datasets.images.image_headers import check_file_ends
from robocas_ms3.datasets.sources.arrays import fingerprint_arrays, read_arrays
from robocas_ms3.datasets.sources.file_models import ConversionRecord
from robocas_ms3.datasets.sources.reader import Dataset

KEEP_RULE = "each episode keeps the split of its source dataset"
_NO_LINKS = {errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS}


@dataclass(frozen=True)
class FinishedDataset:
    """Dataset whose files are complete and consistent, see `open_finished_dataset`.

    Attributes:
        dataset: the open dataset.
        name: name of the dataset in ``conversion.json`` of a copy.
        entries: entry of each episode in ``conversion.json``, by number.
    """

    dataset: Dataset
    name: str
    entries: Mapping[int, dict[str, Any]]

    @property
    def root(self) -> Path:
        return self.dataset.root

    def recording_id(self, number: int) -> str:
        """Return the fingerprint of the recording of an episode, or of its arrays if the recording is unknown."""
        recording = self.entries[number].get("recording")
        return recording or f"arrays {fingerprint_arrays(self.dataset.episode(number).arrays)}"


def find_schema_version(dataset: Dataset) -> object:
    """Return the schema version of a dataset; 0: the format of RoboCAS-v0."""
    return dataset.settings.get("schema_version", 1) if dataset.settings else 0


def open_finished_dataset(root: Path, name: str = "") -> FinishedDataset:
    """Open a dataset to copy episodes from; raise DatasetError if it is unfinished or inconsistent."""
    dataset = Dataset(root)
    schema.check_version(find_schema_version(dataset), root)
    if not dataset.info:
        path, fix = root / schema.DATA_INFO_FILE, "Run robocas convert again with the same arguments."
        raise DatasetError("this dataset is unfinished", where=path, found="no file", fix=fix)
    listed = [number for numbers in dataset.splits for number in numbers]
    if sorted(listed) != dataset.numbers:
        found = (
            f"{format_ranges(set(listed) ^ set(dataset.numbers)) or 'some episodes'} missing, repeated, or not on disk"
        )
        fix = "Finish it with robocas convert, or run robocas split --in-place to accept the episodes on disk."
        raise DatasetError(
            "listed episodes differ from those on disk", where=root / schema.DATA_INFO_FILE, found=found, fix=fix
        )
    where = root / schema.CONVERSION_FILE
    parse(ConversionRecord, dataset.settings, DatasetError, where=where)
    entries = {int(number): entry for number, entry in dataset.settings.get("episodes", {}).items()}
    unlisted = [number for number in dataset.numbers if number not in entries]
    if unlisted:
        raise DatasetError("episodes on disk are not listed", where=where, found=format_ranges(unlisted))
    for number in dataset.numbers:
        episode = dataset.episode(number)
        found = episode.scene.get("schema_version", 1)
        schema.check_version(found, episode.folder / schema.SCENE_FILE, "an episode")
    return FinishedDataset(dataset, name or root.resolve().name, entries)


@dataclass(frozen=True)
class CopiedEpisode:
    """Episode to copy, and its split in the new dataset."""

    source: FinishedDataset
    number: int
    split: Literal["train", "val"]


@dataclass(frozen=True)
class CopyOptions:
    """Options of copying episodes.

    Attributes:
        link: hard-link files if the file system allows it; edits of a linked file change the source too.
        overwrite: delete the output and start again, instead of continuing.
        on_start: called with the number of episodes to write.
        on_episode: called with the number of each written episode.
    """

    link: bool = True
    overwrite: bool = False
    on_start: Callable[[int], None] | None = None
    on_episode: Callable[[int], None] | None = None


@dataclass(frozen=True)
class CopyResult:
    """Result of copying episodes to a new dataset.

    Attributes:
        out: folder of the new dataset.
        episodes: number of its episodes.
        existing: number of episodes that existed already.
        linked: number of hard-linked files.
        copied: number of copied files.
        skipped: number of skipped duplicate episodes.
    """

    out: Path
    episodes: int
    existing: int
    linked: int
    copied: int
    skipped: int = 0

    def __str__(self) -> str:
        existing = f" ({self.existing} already there)" if self.existing else ""
        linked = f"{format_count(self.linked, 'file')} linked, {self.copied} copied"
        skipped = f", {format_count(self.skipped, 'duplicate')} skipped" if self.skipped else ""
        return f"{self.out}: {format_count(self.episodes, 'episode')}{existing}, {linked}{skipped}"


def copy_episodes(
    outputs: Mapping[Path, Sequence[CopiedEpisode]], split_rule: str, options: CopyOptions
) -> list[CopyResult]:
    """Write one dataset per output folder with the given episodes, numbered from 0 in their order.

    All inputs are checked before anything is written. The same call continues an interrupted call, with the same
    result. ``split_rule``: description of the split for ``conversion.json``.
    """
    numbers: dict[Path, list[int]] = {}
    for member in (member for members in outputs.values() for member in members):
        numbers.setdefault(member.source.root, []).append(member.number)
    records = {out: _make_conversion_record(members, split_rule) for out, members in outputs.items()}
    for out, record in records.items():
        check_no_overlap(out, list(numbers))
        OutputFolder(out, DATASET, _drop_versions(record), overwrite=options.overwrite).read_record()
    for root, chosen in numbers.items():
        _check_episodes(root, chosen)
    if options.on_start:
        folders = [out / schema.episode_folder(n) for out, members in outputs.items() for n in range(len(members))]
        options.on_start(sum(options.overwrite or not folder.is_dir() for folder in folders))
    return [_copy_dataset(out, members, records[out], options) for out, members in outputs.items()]


def _copy_dataset(
    out: Path, members: Sequence[CopiedEpisode], record: Mapping[str, Any], options: CopyOptions
) -> CopyResult:
    copier = FileCopier(options.link)
    with open_dataset_output(out, record, options.overwrite):
        missing = [n for n in range(len(members)) if not (out / schema.episode_folder(n)).is_dir()]
        for number in missing:
            member = members[number]
            with atomic_folder(out / schema.episode_folder(number)) as folder:
                copier.copy_tree(member.source.root / schema.episode_folder(member.number), folder)
            if options.on_episode:
                options.on_episode(number)
        train, val = ([n for n, member in enumerate(members) if member.split == name] for name in ("train", "val"))
        write_data_info(out, (train, val))
    return CopyResult(out, len(members), len(members) - len(missing), copier.linked, copier.copied)


def _make_conversion_record(members: Sequence[CopiedEpisode], split_rule: str) -> dict[str, Any]:
    episodes = {}
    for number, member in enumerate(members):
        entry = member.source.entries[member.number]
        origin = {"from": entry["from"]} if "from" in entry else {}  # of an episode that is a copy itself
        episodes[str(number)] = {**entry, "from": {"dataset": member.source.name, "episode": member.number, **origin}}
    settings = members[0].source.dataset.settings
    return {**make_copied_header({key: settings[key] for key in SETTINGS_KEYS}, split_rule), "episodes": episodes}


def make_copied_header(settings: Mapping[str, Any], split_rule: str) -> dict[str, Any]:
    """Make ``conversion.json`` of a merged or split dataset, without the episodes."""
    return {**make_header(settings, split_rule), "made_with": {"robocas_ms3": robocas_ms3.__version__}}


@contextmanager
def open_dataset_output(out: Path, record: Mapping[str, Any], overwrite: bool) -> Iterator[None]:
    """Start or continue a merged or split dataset inside a ``with`` statement.

    An existing ``conversion.json`` must equal ``record``, except for versions.
    """
    with OutputFolder(out, DATASET, _drop_versions(record), overwrite=overwrite) as output:
        output.start(record)
        yield


def _drop_versions(record: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key != "made_with"}


def check_no_overlap(out: Path, inputs: Sequence[Path]) -> None:
    """Raise DatasetError if the output folder is an input folder, contains one, or is inside one."""
    target = out.resolve()
    for path in (path.resolve() for path in inputs):
        if path == target or path in target.parents or target in path.parents:
            raise DatasetError(
                "the output folder overlaps an input", where=out, found=path, fix="Choose another --out."
            )


def _check_episodes(root: Path, numbers: Iterable[int]) -> None:
    """Check arrays, cameras and images of episodes; arrays that an import could not derive may be missing."""
    _, image_options, _ = read_settings(root)
    for folder in (root / schema.episode_folder(number) for number in numbers):
        stored = read_arrays(folder / schema.EPISODE_FILE)
        source = read_json_object(folder, schema.SCENE_FILE)[0].get("source")
        missing = source.get("missing") if isinstance(source, dict) else None
        lacking = missing if isinstance(missing, list) else []
        for wrong in (
            *(wrong for wrong in array_checks.check_keys(stored) if wrong.key not in lacking),
            *array_checks.run_checks(
                stored, (array_checks.check_file, array_checks.check_shapes, array_checks.check_finite)
            ),
            *check_cameras(folder, image_options),
            *check_images(folder, image_options, stored.steps, {}, check_file_ends),
        ):
            if wrong.kind != "unexpected":
                raise damaged_episode_error(root, wrong)


def damaged_episode_error(root: Path, wrong: Violation) -> DatasetError:
    """Make the error for a violation in an episode of the dataset ``root``."""
    where, fix = root / wrong.where, f"Run robocas validate {root} for all violations."
    return DatasetError("this episode is damaged", where=where, expected=wrong.expected, found=wrong.found, fix=fix)


@dataclass
class FileCopier:
    """Hard-links or copies files into a dataset, and counts linked and copied files."""

    link: bool
    linked: int = 0
    copied: int = 0

    def copy_file(self, source: Path, target: Path) -> None:
        """Hard-link a file, or copy it if links are not requested or not possible."""
        if self.link and not source.is_symlink():
            try:
                os.link(source, target)
                self.linked += 1
                return
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
                self.link = error.errno == errno.EMLINK  # limit of this file only
        check_regular_file(source)
        shutil.copyfile(source, target)
        self.copied += 1

    def copy_tree(self, source: Path, target: Path) -> None:
        """Hard-link or copy all files of a folder, except hidden files, into an existing folder."""
        with os.scandir(source) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                if entry.name.startswith("."):
                    continue
                if entry.is_dir():
                    (target / entry.name).mkdir()
                    self.copy_tree(Path(entry.path), target / entry.name)
                elif entry.is_file():
                    self.copy_file(Path(entry.path), target / entry.name)
