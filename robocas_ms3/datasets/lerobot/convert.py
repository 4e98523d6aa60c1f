"""From a trajectory, or a RoboCAS dataset, to a LeRobot dataset."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from robocas_ms3.core.errors import DatasetError, IncompleteError
from robocas_ms3.core.files import flush_to_disk, make_folder, naming, remove, write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.core.outputs import check_there, claim_output, kept_if_begun, sweep, while_there
from robocas_ms3.core.workers import Limits as EpisodeLimits
from robocas_ms3.datasets.lerobot.plan import PARTS, PLAN, check_resume, only, plan_of
from robocas_ms3.datasets.lerobot.schema import CONTENT, INFO_FILE, STAGING, Limits, require_extra, whole_rate
from robocas_ms3.datasets.lerobot.variants import NEWEST, find_variant
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.writing.convert import Conversion
from robocas_ms3.datasets.writing.dataset_player import open_player
from robocas_ms3.datasets.writing.frames import OpenSource
from robocas_ms3.datasets.writing.output import check_overwrite
from robocas_ms3.datasets.writing.players import Request, open_env
from robocas_ms3.datasets.writing.writer import WrittenEpisode

Codec = Literal["h264", "av1"]

_JOINED = ".joined"
_FOLDERS = (*CONTENT, STAGING, "meta")  # meta comes last: where it is, the dataset is whole
_log = logging.getLogger(__name__)


def convert_lerobot(
    source: str | Path,
    out: str | Path,
    *,
    rate_hz: float | None = None,
    pictures: Pictures | None = None,
    codec: Codec = "h264",
    lerobot_version: str = NEWEST,
    include_failed: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    leave_out: bool = False,
    jobs: int = 1,
    pack: str | Path | None = None,
    limits: Limits | None = None,
    episode_limits: EpisodeLimits | None = None,
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[WrittenEpisode], None] | None = None,
    open_source: OpenSource = open_env,
) -> Conversion:
    """Write a LeRobot dataset.

    Episodes are written one by one into ``out/.parts`` and joined at the end, without encoding again. Killed at any
    moment, it goes on with ``resume`` and ends as if it had not been; until it is done there is no ``meta`` folder.

    Args:
        source: ``F.h5``, which is rendered, or the folder of a RoboCAS dataset.
        out: the dataset's folder.
        rate_hz: steps a second, a whole number; default: 5, or the folder's.
        pictures: cameras, size, depth; default: all, as they are.
        codec: of RGB.
        lerobot_version: of the LeRobot that will read the dataset, see `variants.VARIANTS`.
        include_failed: also convert episodes without success.
        overwrite: replace what is in ``out``.
        resume: keep the episodes that are there.
        leave_out: make the dataset without episodes that can't be written, which a warning names; default: write all
            others, and raise an error.
        jobs: worker processes.
        pack: name or folder of the objects' pack, instead of what a trajectory names.
        limits: sizes of files; default: LeRobot's.
        episode_limits: what an episode may take, as in `writing.convert.convert`.
        on_start: called with the number of episodes to write.
        on_episode: called after each.
        open_source: what shows a trajectory's states; must be importable by workers.

    Raises:
        DatasetError: no such version, the input is unusable, nothing to convert, no render device, or a rate
            that LeRobot does not have.
        IncompleteError: episodes can't be written; all others are, and ``resume`` goes on.
        OutputExistsError: ``out`` is not empty and no flag is set.
        MissingExtraError: the ``lerobot`` extra is not installed.
    """
    require_extra()
    begun, variant = time.perf_counter(), find_variant(lerobot_version)
    out, limits = Path(out), limits or Limits()
    pictures = replace(pictures or Pictures(), boxes=variant.language)
    request = Request(Path(source), rate_hz, pictures, include_failed, open_source, pack)
    with closing(open_player(request)) as player:
        fps = whole_rate(player.rate_hz)
        plan = plan_of(player, fps, codec, variant.version)
        with locked_folder(out):
            # Everything that may fail comes before the output is touched.
            claim_output(out, resume=resume or overwrite)
            if resume:
                check_resume(out, plan)
            elif overwrite:
                check_overwrite(out, (INFO_FILE, PARTS), "a LeRobot dataset")
            if request.renders:
                from robocas_ms3.datasets.writing.render import require_renderer

                require_renderer()
            claim_output(out, overwrite=overwrite and not resume, resume=True)
            written: list[WrittenEpisode] = []
            joining = 0.0
            if not (out / INFO_FILE).is_file():
                parts = make_folder(out / PARTS)
                with while_there(parts / PLAN, DatasetError), kept_if_begun(out, parts):
                    _sweep(out)
                    write_json(parts / PLAN, plan)
                    written, failed = _stage(request, parts, plan, jobs, episode_limits, on_start, on_episode)
                    if failed and not leave_out:
                        raise failed
                    if failed:
                        _log.warning("%s", failed)
                    staged = time.perf_counter()
                    plan = _join(out, plan, fps, limits, failed)
                    joining = time.perf_counter() - staged
            for name in (PARTS, _JOINED):
                shutil.rmtree(out / name, ignore_errors=True)
    return Conversion(written, len(plan["episodes"]) - len(written), time.perf_counter() - begun, joining)


def _stage(
    request: Request,
    parts: Path,
    plan: dict[str, Any],
    jobs: int,
    limits: EpisodeLimits | None,
    on_start: Callable[[int], None] | None,
    on_episode: Callable[[WrittenEpisode], None] | None,
) -> tuple[list[WrittenEpisode], IncompleteError | None]:
    """Write the parts that are missing; gives them by number, and what is wrong with those that can't be written."""
    from robocas_ms3.datasets.lerobot.stage import StageJob, is_whole, part_folder, stage_all

    entries = plan["episodes"]
    for folder in (part_folder(parts, index) for index in range(len(entries))):
        if folder.is_dir() and not is_whole(folder):
            _log.warning("%s: damaged since it was written; it is written again", folder)
            shutil.rmtree(folder)
    missing = [(i, e["source"]) for i, e in enumerate(entries) if not part_folder(parts, i).is_dir()]
    if on_start:
        on_start(len(missing))
    settings = plan["settings"]
    variant = find_variant(settings["lerobot_version"])
    job = StageJob(request, parts, settings["codec"], variant, missing, limits, begun=len(missing) < len(entries))
    written: list[WrittenEpisode] = []
    failed: IncompleteError | None = None
    try:
        with closing(stage_all(job, jobs)) as episodes:
            for episode in episodes:
                check_there(parts / PLAN, DatasetError)
                written.append(episode)
                if on_episode:
                    on_episode(episode)
    except IncompleteError as error:
        failed = error
    return sorted(written, key=lambda episode: episode.number), failed


def _join(out: Path, plan: dict[str, Any], fps: int, limits: Limits, failed: IncompleteError | None) -> dict[str, Any]:
    """Make the dataset of the parts that are there; gives the plan of those."""
    from robocas_ms3.datasets.lerobot.assemble import assemble
    from robocas_ms3.datasets.lerobot.stage import part_folder

    folders = {index: part_folder(out / PARTS, index) for index in range(len(plan["episodes"]))}
    if failed:
        reasons = {index: failed.reasons[one.name] for index, one in folders.items() if one.name in failed.reasons}
        folders = {index: folder for index, folder in folders.items() if folder.is_dir()}
        plan = only(plan, list(folders), reasons)
    joined = make_folder(out / _JOINED)
    with naming(joined):
        assemble(list(folders.values()), plan, fps, joined, limits)
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
