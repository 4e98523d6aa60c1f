"""From a trajectory, or a RoboCAS dataset, to a LeRobot dataset."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import robocas_ms3
from robocas_ms3.datasets.lerobot.schema import CONTENT, CONVERSION_FILE, INFO_FILE, Limits, require_extra, whole_rate
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.datasets.writing.convert import Conversion
from robocas_ms3.datasets.writing.dataset_player import open_player
from robocas_ms3.datasets.writing.frames import OpenSource
from robocas_ms3.datasets.writing.output import check_overwrite
from robocas_ms3.datasets.writing.players import Player, Request, open_env
from robocas_ms3.datasets.writing.writer import WrittenEpisode
from robocas_ms3.documents import load_json
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import make_folder, naming, write_json
from robocas_ms3.outputs import (
    check_same,
    check_there,
    claim_output,
    is_taken,
    kept_if_begun,
    locked_folder,
    sweep,
    while_there,
)
from robocas_ms3.processes import Limits as EpisodeLimits
from robocas_ms3.words import count_of

Codec = Literal["h264", "av1"]

PARTS = ".parts"
"""Folder of the episodes done so far; gone when the dataset is there."""
_PLAN, _JOINED = "plan.json", ".joined"
_FOLDERS = (*CONTENT, "meta")  # meta comes last: where it is, the dataset is whole


def convert_lerobot(
    source: str | Path,
    out: str | Path,
    *,
    rate_hz: float | None = None,
    pictures: Pictures | None = None,
    codec: Codec = "h264",
    include_failed: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    jobs: int = 1,
    pack: str | Path | None = None,
    limits: Limits | None = None,
    episode_limits: EpisodeLimits | None = None,
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[WrittenEpisode], None] | None = None,
    open_source: OpenSource = open_env,
) -> Conversion:
    """Write a LeRobot dataset v3.0.

    Episodes are written one by one into ``out/.parts`` and joined at the end, without encoding again. Killed at any
    moment, it goes on with ``resume`` and ends as if it had not been; until it is done there is no ``meta`` folder.

    Args:
        source: ``F.h5``, which is rendered, or the folder of a RoboCAS dataset.
        out: the dataset's folder.
        rate_hz: steps a second, a whole number; default: 5, or the folder's.
        pictures: cameras, size, depth; default: all, as they are.
        codec: of RGB.
        include_failed: also convert episodes without success.
        overwrite: replace what is in ``out``.
        resume: keep the episodes that are there.
        jobs: worker processes.
        pack: name or folder of the objects' pack, instead of what a trajectory names.
        limits: sizes of files; default: LeRobot's.
        episode_limits: what an episode may take, as in `writing.convert.convert`.
        on_start: called with the number of episodes to write.
        on_episode: called after each.
        open_source: what shows a trajectory's states; must be importable by workers.

    Raises:
        DatasetError: the input is unusable, nothing to convert, no render device, a rate that LeRobot can't have.
        OutputExistsError: ``out`` is not empty and no flag is set.
        MissingExtraError: the ``lerobot`` extra is not installed.
    """
    require_extra()
    begun = time.perf_counter()
    out, limits = Path(out), limits or Limits()
    request = Request(Path(source), rate_hz, pictures or Pictures(), include_failed, open_source, pack)
    with closing(open_player(request)) as player:
        fps = whole_rate(player.rate_hz)
        plan = _plan(player, fps, codec)
        with locked_folder(out):
            # Everything that may fail comes before the output is touched.
            claim_output(out, resume=resume or overwrite)
            if resume:
                _check_resume(out, plan)
            elif overwrite:
                check_overwrite(out, (INFO_FILE, PARTS), "a LeRobot dataset")
            if request.renders:
                from robocas_ms3.datasets.writing.render import require_renderer

                require_renderer()
            claim_output(out, overwrite=overwrite and not resume, resume=True)
            written, joining = [], 0.0
            if not (out / INFO_FILE).is_file():
                parts = make_folder(out / PARTS)
                with while_there(parts / _PLAN, DatasetError), kept_if_begun(out, parts):
                    _sweep(out)
                    if not (parts / _PLAN).is_file():
                        write_json(parts / _PLAN, plan)
                    written = _stage(request, parts, plan, jobs, episode_limits, on_start, on_episode)
                    staged = time.perf_counter()
                    _join(out, plan, fps, limits)
                    joining = time.perf_counter() - staged
            for name in (PARTS, _JOINED):
                shutil.rmtree(out / name, ignore_errors=True)
    return Conversion(written, len(plan["episodes"]) - len(written), time.perf_counter() - begun, joining)


def _plan(player: Player, fps: int, codec: str) -> dict[str, Any]:
    entries, pictures = player.entries(), player.pictures
    place = {entry["source"]: i for i, entry in enumerate(entries)}
    before_train, before_val = ([place[n] for n in side if n in place] for side in player.sides())
    seeds = {i: i if e["seed"] is None else _seed(e["seed"]) for i, e in enumerate(entries)}
    train, val = split_by_seed(seeds, (before_train, before_val))
    plan = {
        "format": "lerobot",
        "made_with": {"robocas_ms3": robocas_ms3.__version__},
        "settings": {
            "rate_hz": fps,
            "cameras": list(pictures.cameras),
            "depth": pictures.depth,
            "codec": codec,
            "size": pictures.size,
        },
        "train_eps": train,
        "val_eps": val,
        "episodes": entries,
    }
    return json.loads(json.dumps(plan))


def _seed(seed: Any) -> int:
    return int(seed[0] if isinstance(seed, list) else seed)


def _stage(
    request: Request,
    parts: Path,
    plan: dict[str, Any],
    jobs: int,
    limits: EpisodeLimits | None,
    on_start: Callable[[int], None] | None,
    on_episode: Callable[[WrittenEpisode], None] | None,
) -> list[WrittenEpisode]:
    """Write the parts that are missing; gives them by number."""
    from robocas_ms3.datasets.lerobot.stage import StageJob, part_folder, stage_all

    missing = [(i, e["source"]) for i, e in enumerate(plan["episodes"]) if not part_folder(parts, i).is_dir()]
    if on_start:
        on_start(len(missing))
    written: list[WrittenEpisode] = []
    with closing(stage_all(StageJob(request, parts, plan["settings"]["codec"], missing, limits), jobs)) as episodes:
        for episode in episodes:
            check_there(parts / _PLAN, DatasetError)
            written.append(episode)
            if on_episode:
                on_episode(episode)
    return sorted(written, key=lambda episode: episode.number)


def _join(out: Path, plan: dict[str, Any], fps: int, limits: Limits) -> None:
    """Make the dataset of the parts."""
    from robocas_ms3.datasets.lerobot.assemble import assemble

    joined = make_folder(out / _JOINED)
    with naming(joined):
        assemble(out / PARTS, plan, fps, joined, limits)
    for name in _FOLDERS:
        if (joined / name).is_dir():
            os.replace(joined / name, out / name)
    joined.rmdir()


def _sweep(out: Path) -> None:
    """Remove what a killed conversion left half written or half joined."""
    for name in (_JOINED, *_FOLDERS):
        if (out / name).is_dir():
            shutil.rmtree(out / name)
    sweep(out / PARTS)


def _check_resume(out: Path, plan: dict[str, Any]) -> None:
    """Go on with the same conversion only.

    Raises:
        DatasetError: another one was begun in ``out``, or something else is there.
    """
    if not is_taken(out):
        return
    path = out / CONVERSION_FILE if (out / INFO_FILE).is_file() else out / PARTS / _PLAN
    try:
        before = load_json(path)
    except (OSError, ValueError) as error:
        if (out / PARTS).is_dir() and not any((out / PARTS).glob("episode_*")):
            return  # killed before it wrote what it was to do
        what = "can't resume: no conversion to LeRobot was begun here"
        raise DatasetError(what, where=path, fix="Pass --overwrite.") from error
    check_same(
        before.get("settings", {}),
        plan["settings"],
        "can't resume with other settings",
        where=path,
        fix="Pass --overwrite, or the settings of before.",
        error=DatasetError,
    )
    if before.get("episodes") != plan["episodes"]:
        raise DatasetError(
            "can't resume: these episodes are not what was begun here",
            where=path,
            expected=f"{count_of(len(before.get('episodes', [])), 'episode')}",
            found=f"{len(plan['episodes'])}",
            fix="Pass --overwrite to begin again.",
        )
