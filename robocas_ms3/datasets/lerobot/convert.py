"""Convert a trajectory, or a dataset of another format, to a LeRobot dataset."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import IncompleteError
from robocas_ms3.core.files import flush_to_disk, make_folder, naming, remove
from robocas_ms3.core.outputs import OutputFolder, sweep
from robocas_ms3.datasets.lerobot.plan import OUTPUT, PARTS, check_episodes, only, plan_of
from robocas_ms3.datasets.lerobot.schema import (
    CONTENT,
    INFO_FILE,
    STAGING,
    Limits,
    check_video_size,
    require_extra,
    whole_rate,
)
from robocas_ms3.datasets.lerobot.variants import Variant, find_variant
from robocas_ms3.datasets.writing.inputs import open_input
from robocas_ms3.datasets.writing.settings import Conversion, ConversionSettings, WrittenEpisode
from robocas_ms3.datasets.writing.workers import WriteJob, write_missing

FILE_LIMITS = Limits()
"""Sizes of files: LeRobot's."""
_JOINED = ".joined"
_FOLDERS = (*CONTENT, STAGING, "meta")  # meta comes last: where it is, the dataset is whole
_FIX = "The same command tries again; with --leave-out, the others make the dataset where that fails."
_log = logging.getLogger(__name__)


def convert_lerobot(
    settings: ConversionSettings,
    *,
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[WrittenEpisode], None] | None = None,
) -> Conversion:
    """Write a LeRobot dataset.

    Episodes are written one by one into ``out/.parts`` and joined at the end, without encoding again. Called
    again after a kill, it continues, with the same result; until it is done there is no ``meta`` folder.

    Args:
        settings: what is converted, and how; with ``leave_out`` the dataset is joined without the episodes that can't
            be written.
        on_start: called with the number of episodes to write.
        on_episode: called after each.

    Raises:
        DatasetError: no such version, the input is unusable, nothing to convert, no render device, or a rate
            that LeRobot does not have.
        IncompleteError: episodes can't be written; all others are, and the same call tries again.
        OutputExistsError: ``out`` is a dataset of other settings, versions or episodes, or none.
        RobocasError: another conversion is running.
        MissingExtraError: the ``lerobot`` extra is not installed.
    """
    require_extra()
    check_video_size(settings.pictures.size)
    start, variant, out = time.perf_counter(), find_variant(settings.lerobot_version), settings.out
    settings = replace(settings, pictures=replace(settings.pictures, boxes=variant.language))
    with closing(open_input(settings)) as given:
        fps = whole_rate(given.source.rate_hz)
        plan = plan_of(given, fps, settings.codec, variant.version)
        recorded_settings = {key: plan[key] for key in ("settings", "made_with")}
        with OutputFolder(out, OUTPUT, recorded_settings, overwrite=settings.overwrite) as output:
            check_episodes(output, plan)  # everything that may fail comes before the output is touched
            if settings.needs_device:
                from robocas_ms3.datasets.writing.render import require_renderer

                require_renderer()
            written: list[WrittenEpisode] = []
            joining = 0.0
            if output.recorded is None or not (out / INFO_FILE).is_file():
                output.start(plan)
                _sweep(out)
                job = _missing(settings, variant, plan)
                if on_start:
                    on_start(len(job.tasks))
                written, incomplete = write_missing(job, output, on_episode)
                if incomplete and not settings.leave_out:
                    raise incomplete
                if incomplete:
                    _log.warning("%s", incomplete)
                staged = time.perf_counter()
                plan = _join(out, plan, fps, incomplete)
                joining = time.perf_counter() - staged
            for name in (PARTS, _JOINED):
                shutil.rmtree(out / name, ignore_errors=True)
    return Conversion(written, len(plan["episodes"]) - len(written), time.perf_counter() - start, joining)


def _missing(settings: ConversionSettings, variant: Variant, plan: dict[str, Any]) -> WriteJob:
    """Return the parts that are missing; one that is damaged is removed, and is missing."""
    from robocas_ms3.datasets.lerobot.stage import PartWriter, is_whole, part_folder

    parts, entries = settings.out / PARTS, plan["episodes"]
    for folder in (part_folder(parts, index) for index in range(len(entries))):
        if folder.is_dir() and not is_whole(folder):
            _log.warning("%s: damaged since it was written; it is written again", folder)
            shutil.rmtree(folder)
    missing = [(i, e["source"]) for i, e in enumerate(entries) if not part_folder(parts, i).is_dir()]
    writer = PartWriter(parts, settings.codec, variant)
    return WriteJob(settings, writer, missing, len(missing) < len(entries), _FIX)


def _join(out: Path, plan: dict[str, Any], fps: int, incomplete: IncompleteError | None) -> dict[str, Any]:
    """Make the dataset of the parts that are there; return the plan of those."""
    from robocas_ms3.datasets.lerobot.assemble import assemble
    from robocas_ms3.datasets.lerobot.stage import part_folder

    folders = {index: part_folder(out / PARTS, index) for index in range(len(plan["episodes"]))}
    if incomplete:
        why = incomplete.reasons
        reasons = {index: why[folder.name] for index, folder in folders.items() if folder.name in why}
        folders = {index: folder for index, folder in folders.items() if folder.is_dir()}
        plan = only(plan, list(folders), reasons)
    joined = make_folder(out / _JOINED)
    with naming(joined):
        assemble(list(folders.values()), plan, fps, joined, FILE_LIMITS)
        flush_to_disk(joined)  # before the parts go
    for name in _FOLDERS:
        if (joined / name).is_dir():
            os.replace(joined / name, out / name)
    joined.rmdir()
    return plan


def _sweep(out: Path) -> None:
    """Remove what a killed conversion left half written or half joined."""
    for name in (_JOINED, *_FOLDERS):
        if os.path.lexists(out / name):
            remove(out / name)
    sweep(out / PARTS)
