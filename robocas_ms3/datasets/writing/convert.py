"""From a ManiSkill trajectory to a RoboCAS dataset."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError, IncompleteError
from robocas_ms3.core.files import make_folder, write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.core.outputs import check_there, claim_output, kept_if_begun, sweep, while_there
from robocas_ms3.core.workers import Limits
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.preview import FEW, finish_previews, on_sheet
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.writing.cut_off import cut_off
from robocas_ms3.datasets.writing.failures import add_failures
from robocas_ms3.datasets.writing.frames import OpenSource
from robocas_ms3.datasets.writing.info import write_info
from robocas_ms3.datasets.writing.output import check_overwrite
from robocas_ms3.datasets.writing.plan import (
    Plan,
    appended_plan,
    dataset_settings,
    new_plan,
    planned_sides,
    resumed_plan,
    still_missing,
    without_unwritten,
)
from robocas_ms3.datasets.writing.players import Player, RecordingPlayer, Request, open_env
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.datasets.writing.workers import Job, write_all
from robocas_ms3.datasets.writing.writer import WrittenEpisode

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Conversion:
    """What was done.

    Attributes:
        episodes: the new ones, by number.
        kept: how many of the trajectory's were there already (``resume``, ``append``).
        seconds: for everything.
        joining: of these, for what comes after the episodes.
        previews: whether they were made.
    """

    episodes: list[WrittenEpisode]
    kept: int
    seconds: float
    joining: float = 0.0
    previews: bool = False

    @property
    def timing(self) -> Timing:
        """Sum over the new episodes, whichever process wrote them; ``write`` with the joining."""
        return sum((episode.timing for episode in self.episodes), start=Timing(write=self.joining))


def convert(
    trajectory: str | Path,
    out: str | Path,
    *,
    rate_hz: float | None = None,
    pictures: Pictures | None = None,
    embeddings: bool = True,
    include_failed: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    append: bool = False,
    leave_out: bool = False,
    previews: bool | None = False,
    jobs: int = 1,
    pack: str | Path | None = None,
    episode_limits: Limits | None = None,
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[WrittenEpisode], None] | None = None,
    open_source: OpenSource = open_env,
) -> Conversion:
    """Write a RoboCAS dataset from a trajectory file.

    Killed at any moment, it goes on with ``resume`` (or the same ``append`` again), and ends as if it had not been.
    An episode that can't be written costs no other: in the end there is a dataset of the others, and an error.
    Warns where the actions were tried at another rate than that of the dataset.

    Args:
        trajectory: ``F.h5`` with ``F.json`` beside it; a ``failures.jsonl`` in the same folder goes along.
        out: the dataset's folder.
        rate_hz: steps a second; divides the control frequency; None: 5.
        pictures: which ones; default: RGB as PNG and depth of all cameras, 640 x 480.
        embeddings: whether to embed the texts.
        include_failed: also convert episodes without success.
        overwrite: replace what is in ``out``.
        resume: keep the episodes that are there.
        append: add to the dataset in ``out``; what is there keeps its numbers and its side of the split, and recordings
            that it holds already are not added again.
        leave_out: whether episodes that can't be written are no error, but a warning.
        previews: whether to write a video of each new episode, and a contact sheet; None: where they are at most 20.
        jobs: worker processes.
        pack: name or folder of the objects' pack, instead of what the file names.
        episode_limits: what an episode may take. With them one job is a process of its own too, where it renders; an
            episode that goes beyond them, or takes its process down, is begun again once, and then left out, which is
            an error in the end. None: with one job this process does it.
        on_start: called with the number of episodes to write.
        on_episode: called after each.
        open_source: what shows the states; must be importable by workers.

    Raises:
        DatasetError: the input is unusable, nothing to convert, no render device, another conversion is at it.
        IncompleteError: episodes can't be written; the dataset is complete without, ``left_out`` in its
            ``conversion.json`` says why, and ``resume`` tries again.
        OutputExistsError: ``out`` is not empty and no flag is set.
        MissingExtraError: embeddings are wanted and the ``language`` extra is not installed.
    """
    begun = time.perf_counter()
    out = Path(out)
    request = Request(Path(trajectory), rate_hz, pictures or Pictures(), include_failed, open_source, pack)
    with closing(RecordingPlayer(request)) as player:
        settings = dataset_settings(player.rate_hz, player.pictures, embeddings)
        with locked_folder(out):  # from the plan on: it numbers after what is there
            # Everything that may fail comes before the output is touched.
            claim_output(out, resume=resume or append or overwrite)
            entries = player.entries()
            if append:
                plan = appended_plan(out, entries, settings)
            elif resume:
                plan = resumed_plan(out, entries, settings)
            else:
                plan = new_plan(entries, settings)
                if overwrite:
                    check_overwrite(out)
            if request.renders:
                from robocas_ms3.datasets.writing.render import require_renderer

                require_renderer()
            vectors = embed_texts(player, entries) if embeddings else None
            claim_output(out, overwrite=overwrite and not (resume or append), resume=True)
            make_folder(out)
            sweep(out)
            sweep(out / schema.PREVIEW_FOLDER)
            before = _split_before(out)
            _remove_cut_off(out, plan, player.pictures)
            missing = [task for task in plan.tasks if not (out / schema.episode_folder(task[0])).is_dir()]
            if on_start:
                on_start(len(missing))
            sheet = None
            if previews or (previews is None and len(plan.tasks) <= FEW):
                sheet = on_sheet(map(int, plan.content["episodes"]))
            job = Job(request, out, vectors, sheet, missing, episode_limits, begun=len(missing) < len(plan.tasks))
            with while_there(out / schema.CONVERSION_FILE, DatasetError):
                written, incomplete = _write(job, player.file.env_info, plan, before, jobs, on_episode)
            if incomplete and not leave_out:
                raise incomplete
            if incomplete:
                _log.warning("%s", incomplete)
            if left := still_missing(out, plan.content):
                _log.warning("%s: %s are still missing: convert that with --append", out, " and ".join(left))
    written.sort(key=lambda episode: episode.number)
    kept = len(plan.tasks) - len(missing)
    return Conversion(written, kept, time.perf_counter() - begun, previews=sheet is not None)


def _write(
    job: Job,
    env_info: dict[str, Any],
    plan: Plan,
    before: tuple[list[int], list[int]],
    jobs: int,
    on_episode: Callable[[WrittenEpisode], None] | None,
) -> tuple[list[WrittenEpisode], IncompleteError | None]:
    """Write what is missing; gives that, and what is wrong with what can't be written."""
    written: list[WrittenEpisode] = []
    incomplete: IncompleteError | None = None
    with kept_if_begun(job.out):
        write_json(job.out / schema.CONVERSION_FILE, plan.content)
        try:
            with closing(write_all(job, jobs)) as episodes:
                for episode in episodes:
                    check_there(job.out / schema.CONVERSION_FILE, DatasetError)
                    written.append(episode)
                    if on_episode:
                        on_episode(episode)
        except IncompleteError as error:
            incomplete = error
        finally:
            for folder in (job.out, job.out / schema.PREVIEW_FOLDER):
                sweep(folder)  # what processes that died left; others did it again
        if incomplete:
            content = without_unwritten(job.out, plan, incomplete.reasons)
            write_json(job.out / schema.CONVERSION_FILE, content)
        add_failures(job.request.path.parent, job.out, env_info)
        write_info(job.out, planned_sides(plan.content, before))
    if job.sheet is not None:
        finish_previews(job.out, {episode.number: episode.row for episode in written if episode.row is not None})
    return written, incomplete


def _remove_cut_off(out: Path, plan: Plan, pictures: Pictures) -> None:
    """Remove episodes of which a file was cut off since they were written, so that they are written again."""
    for folder in (out / schema.episode_folder(number) for number, _ in plan.tasks):
        if folder.is_dir() and (path := cut_off(folder, pictures)):
            _log.warning("%s: cut off, or gone, since it was written; its episode is written again", path)
            shutil.rmtree(folder)


def _split_before(out: Path) -> tuple[list[int], list[int]]:
    """Training and validation episodes of the dataset that is there, if one is."""
    if not (out / schema.DATA_INFO_FILE).is_file():
        return [], []
    try:
        return Dataset(out).sides
    except DatasetError as error:
        fix = "Delete it, and it is made anew; where there was an --append, episodes may change sides."
        where = out / schema.DATA_INFO_FILE
        raise DatasetError("the split can't be read", where=where, found=error.found, fix=fix) from error


def embed_texts(player: Player, entries: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[np.float32]]:
    """Embed every distinct text here, so that no worker has to load the model."""
    from robocas_ms3.scenes.language.embed import TextEmbedder

    embedder = TextEmbedder()
    texts = list(dict.fromkeys(text for entry in entries for text in _texts(player, entry["source"])))
    return dict(zip(texts, embedder(texts), strict=True))


def _texts(player: Player, number: int) -> list[str]:
    """Of an episode; none where it can't be read, which is said when it is its turn."""
    try:
        return player.texts(number)
    except DatasetError:
        return []
