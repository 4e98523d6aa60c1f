"""Convert a trajectory file to a RoboCAS folder."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.output_folder import OutputFolder, remove_temporary_files
from robocas_ms3.core.strict_model import parse
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.conversion.conversion_input import ConversionInput, open_trajectory
from robocas_ms3.datasets.conversion.data_info import copy_failures, write_data_info
from robocas_ms3.datasets.conversion.episode_folder import FolderWriter, find_damaged_file
from robocas_ms3.datasets.conversion.episode_plan import (
    DATASET,
    describe_missing_episodes,
    make_settings,
    move_unwritten_to_skipped,
    plan_episodes,
    split_planned_episodes,
)
from robocas_ms3.datasets.conversion.rendered_source import RenderedSource
from robocas_ms3.datasets.conversion.settings import ConversionResult, ConversionSettings, WrittenEpisode
from robocas_ms3.datasets.conversion.workers import PendingEpisodes, write_episodes
from robocas_ms3.datasets.images.video import MAX_PREVIEWS, complete_contact_sheet, select_sheet_episodes
from robocas_ms3.datasets.sources.file_models import SettingsRecord
from robocas_ms3.datasets.sources.files import read_json
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.recordings.trajectory_json import package_versions

_FIX = "The dataset of the other episodes is valid. Run the same command to retry, or pass --skip-errors."
_log = logging.getLogger(__name__)


def convert(
    settings: ConversionSettings,
    *,
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[WrittenEpisode], None] | None = None,
) -> ConversionResult:
    """Write a RoboCAS folder from a trajectory file.

    A ``failures.jsonl`` in the folder of the trajectory file is copied. The same call continues an interrupted
    conversion, with the same result. If an episode can't be written, all others are written before the error is raised.
    ``on_start`` is called with the number of episodes to write, ``on_episode`` after each episode.

    Raises:
        DatasetError: the input is damaged or has no episodes to convert, or there is no render device.
        IncompleteDatasetError: some episodes can't be written. The dataset of the others is valid, ``skipped`` in
            ``conversion.json`` has the reasons, and the same call tries the missing episodes again.
        OutputExistsError: ``out`` is not a dataset, has other settings or versions, or, without ``append``, other
            recordings.
        RobocasError: another conversion writes to ``out``.
        MissingExtraError: embeddings are requested and the extra ``language`` is not installed.
    """
    start, out = time.perf_counter(), settings.out
    settings = _inherit_settings(settings)
    with ExitStack() as stack:
        source = stack.enter_context(closing(open_trajectory(settings)))
        image_options = source.image_options
        stored = make_settings(source.rate_hz, image_options, settings.embeddings)
        recorded = {**stored, "made_with": package_versions()}
        output = stack.enter_context(OutputFolder(out, DATASET, recorded, overwrite=settings.overwrite))
        # Everything that may fail runs before the output changes.
        entries = ConversionInput(source, image_options, settings.include_failed).entries()
        content, tasks = plan_episodes(output, entries, stored, append=settings.append)
        settings.require_renderer()
        embed = partial(_look_up_embeddings, embed_texts(source, entries)) if settings.embeddings else None
        output.start(content)
        remove_temporary_files(out / schema.PREVIEW_FOLDER)
        previous = _read_previous_split(out)
        for folder in (out / schema.episode_folder(number) for number, _ in tasks):
            if folder.is_dir() and (path := find_damaged_file(folder, image_options)):
                _log.warning("%s is missing or truncated; its episode is written again", path)
                shutil.rmtree(folder)
        missing = [task for task in tasks if not (out / schema.episode_folder(task[0])).is_dir()]
        if on_start:
            on_start(len(missing))
        sheet = None
        if settings.video and (settings.all_videos or len(tasks) <= MAX_PREVIEWS):
            sheet = select_sheet_episodes(map(int, content["episodes"]))
        pending = PendingEpisodes(settings, FolderWriter(out, embed, sheet), missing, len(missing) < len(tasks), _FIX)
        try:
            written, incomplete = write_episodes(pending, output, on_episode)
        finally:
            for folder in (out, out / schema.PREVIEW_FOLDER):
                remove_temporary_files(folder)  # of workers that crashed
        if incomplete:
            write_json(out / schema.CONVERSION_FILE, move_unwritten_to_skipped(out, content, incomplete.reasons))
        copy_failures(settings.source.parent, out, source.file.env_info)
        write_data_info(out, split_planned_episodes(content, previous))
        if sheet is not None:
            rows = {episode.number: episode.row for episode in written if episode.row is not None}
            complete_contact_sheet(Dataset(out), rows)
        if incomplete and not settings.skip_errors:
            raise incomplete
        if incomplete:
            _log.warning("%s", incomplete)
        if missing_names := describe_missing_episodes(out, content):
            _log.warning("%s: %s are missing; add them with robocas convert --append", out, " and ".join(missing_names))
    return ConversionResult(written, len(tasks) - len(missing), time.perf_counter() - start, previews=sheet is not None)


def _inherit_settings(settings: ConversionSettings) -> ConversionSettings:
    """Fill in cameras and image size from the dataset to append to, unless they are given."""
    path = settings.out / schema.CONVERSION_FILE
    stored = read_json(path) if settings.append else {}
    if not stored:
        return settings
    schema.check_version(stored.get("schema_version", 1), path)
    dataset = parse(SettingsRecord, stored, DatasetError, where=path)
    size = (dataset.image_size[0], dataset.image_size[1]) if dataset.image_size else None
    return replace(settings, cameras=settings.cameras or tuple(dataset.cameras), size=settings.size or size)


def _read_previous_split(out: Path) -> tuple[list[int], list[int]]:
    if not (out / schema.DATA_INFO_FILE).is_file():
        return [], []
    try:
        return Dataset(out).splits
    except DatasetError as error:
        fix = "Delete the file to split again; after an --append, episodes may move between training and validation."
        where = out / schema.DATA_INFO_FILE
        raise DatasetError("the split can't be read", where=where, found=error.found, fix=fix) from error


def embed_texts(source: RenderedSource, entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Compute the embedding (384,) of each instruction and sub-goal text of the given episodes, by text."""
    from robocas_ms3.scenes.language.embed import TextEmbedder

    embedder = TextEmbedder()
    texts = list(dict.fromkeys(text for entry in entries for text in _list_texts(source, entry["source"])))
    return dict(zip(texts, embedder(texts), strict=True))


def _look_up_embeddings(vectors: dict[str, Any], texts: list[str]) -> NDArray[np.float32]:
    return np.stack([vectors[text] for text in texts])


def _list_texts(source: RenderedSource, number: int) -> list[str]:
    """Return the instruction and the sub-goal texts of an episode; empty if the episode can't be read.

    The error is raised later, when the episode is written.
    """
    try:
        return source.list_texts(number)
    except DatasetError:
        return []
