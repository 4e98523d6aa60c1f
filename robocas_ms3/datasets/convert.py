"""From a ManiSkill trajectory to a RoboCAS dataset."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robocas_ms3
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.episode import sample_states, sample_stride, sample_subgoals
from robocas_ms3.datasets.info import SPLIT_RULE, action_space, data_info
from robocas_ms3.datasets.trajectory import TrajectoryFile
from robocas_ms3.datasets.workers import Job, OpenSource, write_all
from robocas_ms3.datasets.writer import FrameSource, WrittenEpisode
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import claim_output, make_folder, write_json


@dataclass(frozen=True)
class Conversion:
    """What was done.

    Attributes:
        episodes: the new ones, by number.
        kept: how many were there already (``resume``).
        seconds: for everything.
    """

    episodes: list[WrittenEpisode]
    kept: int
    seconds: float


def open_env(env_info: dict[str, Any], control_mode: str, size: tuple[int, int] | None) -> FrameSource:
    """Show states through the environment that recorded them."""
    from robocas_ms3.datasets.render import EnvFrames

    return EnvFrames(env_info, control_mode, size)


def convert(
    trajectory: str | Path,
    out: str | Path,
    *,
    rate_hz: float = 5.0,
    embeddings: bool = True,
    size: tuple[int, int] | None = None,
    include_failed: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    jobs: int = 1,
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[WrittenEpisode], None] | None = None,
    open_source: OpenSource = open_env,
) -> Conversion:
    """Write a RoboCAS dataset from a trajectory file.

    Args:
        trajectory: ``F.h5`` with ``F.json`` beside it.
        out: the dataset's folder.
        rate_hz: steps a second; divides the control frequency.
        embeddings: whether to embed the texts.
        size: width and height of the pictures; None: 640 x 480.
        include_failed: also convert episodes without success.
        overwrite: replace what is in ``out``.
        resume: keep the episodes that are there.
        jobs: worker processes.
        on_start: called with the number of episodes to write.
        on_episode: called after each.
        open_source: what shows the states; must be importable by workers.

    Raises:
        DatasetError: the input is unusable, nothing to convert, no render device.
        OutputExistsError: ``out`` is not empty and neither flag is set.
        MissingExtraError: embeddings are wanted and the ``language`` extra is not installed.
    """
    begun = time.perf_counter()
    out = Path(out)
    with TrajectoryFile(trajectory) as file:
        stride = sample_stride(file.control_freq, rate_hz)
        chosen = _choose(file, include_failed)
        settings = _settings(file, chosen, rate_hz, embeddings, size)
        # Everything that may fail comes before the output is touched.
        claim_output(out, resume=resume or overwrite)
        if resume:
            _check_resume(out, settings)
        elif overwrite:
            _check_overwrite(out)
        if open_source is open_env:
            from robocas_ms3.datasets.render import require_renderer

            require_renderer()
        vectors = _embed_all(file, chosen) if embeddings else None
        claim_output(out, overwrite=overwrite and not resume, resume=resume)
        make_folder(out)
        tasks = [(n, i) for n, i in enumerate(chosen) if not (out / schema.episode_folder(n)).is_dir()]
        if on_start:
            on_start(len(tasks))
        written: list[WrittenEpisode] = []
        try:
            write_json(out / schema.CONVERSION_FILE, settings)
            (out / schema.DATA_INFO_FILE).unlink(missing_ok=True)
            job = Job(file.path, out, stride, size, vectors, open_source, tasks)
            with closing(write_all(job, jobs)) as episodes:
                for episode in episodes:
                    written.append(episode)
                    if on_episode:
                        on_episode(episode)
            write_json(out / schema.DATA_INFO_FILE, _info(file, out, chosen, stride))
        except BaseException:
            if not any(out.glob("episode_*")):
                shutil.rmtree(out, ignore_errors=True)  # nothing came of it
            raise
    written.sort(key=lambda episode: episode.number)
    return Conversion(written, len(chosen) - len(tasks), time.perf_counter() - begun)


def _succeeded(episode: dict[str, Any]) -> bool:
    return bool(np.all(episode.get("success", False)))


def _choose(file: TrajectoryFile, include_failed: bool) -> list[int]:
    chosen = [i for i, episode in enumerate(file.episodes) if include_failed or _succeeded(episode)]
    if not chosen:
        some = bool(file.episodes)
        raise DatasetError(
            "no successful episodes to convert" if some else "no episodes to convert",
            where=file.path,
            found=f"{len(file.episodes)} episodes",
            fix="Pass --include-failed to convert them all the same." if some else "",
        )
    return chosen


def _settings(
    file: TrajectoryFile, chosen: list[int], rate_hz: float, embeddings: bool, size: tuple[int, int] | None
) -> dict[str, Any]:
    episodes = {}
    for number, index in enumerate(chosen):
        episode = file.episodes[index]
        episodes[str(number)] = {
            "trajectory_episode": episode["episode_id"],
            "seed": episode.get("episode_seed"),
            "success": _succeeded(episode),
            "target": episode.get("robocas", {}).get("target"),
        }
    return {
        "format": "robocas",
        "made_with": {"robocas_ms3": robocas_ms3.__version__, "trajectory": file.versions},
        "trajectory": file.path.name,
        "env_info": file.env_info,
        "control_freq": file.control_freq,
        "rate_hz": rate_hz,
        "image_size": list(size) if size else None,
        "embeddings": embeddings,
        "split": SPLIT_RULE,
        "episodes": episodes,
    }


def _check_resume(out: Path, settings: dict[str, Any]) -> None:
    if not out.is_dir() or not any(out.iterdir()):
        return
    path = out / schema.CONVERSION_FILE
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError("can't resume: no conversion was begun here", where=path, fix="Pass --overwrite.") from error
    now = json.loads(json.dumps(settings))
    different = sorted(key for key in now if before.get(key) != now[key])
    if different:
        raise DatasetError(
            "can't resume with other settings",
            where=path,
            found=f"different {', '.join(different)}",
            fix="Pass --overwrite, or the settings of before.",
        )


def _check_overwrite(out: Path) -> None:
    """Delete datasets only, whatever folder was named by mistake."""
    marks = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
    if out.is_dir() and any(out.iterdir()) and not any((out / mark).is_file() for mark in marks):
        raise DatasetError(
            "refusing to overwrite what is not a dataset", where=out, expected=" or ".join(marks), fix="Choose another."
        )


def _embed_all(file: TrajectoryFile, chosen: list[int]) -> dict[str, NDArray[np.float32]]:
    """Embed every distinct text here, so that no worker has to load the model."""
    from robocas_ms3.language.embed import TextEmbedder

    embedder = TextEmbedder()
    texts: dict[str, None] = {}
    for index in chosen:
        recording = file.recording(index)
        texts[recording.instruction] = None
        texts.update(dict.fromkeys(goal.goal_description for goal in recording.subgoals))
    return dict(zip(texts, embedder(texts), strict=True))


def _info(file: TrajectoryFile, out: Path, chosen: list[int], stride: int) -> dict[str, Any]:
    seeds, lengths, instructions, subgoals, positions, turns = {}, {}, {}, {}, [], []
    for number, index in enumerate(chosen):
        recording = file.recording(index)
        samples = sample_states(recording.control_steps, stride)
        seeds[number], lengths[number], instructions[number] = recording.seed, len(samples), recording.instruction
        subgoals[number] = sample_subgoals(recording.subgoals, samples)
        with np.load(out / schema.episode_folder(number) / schema.EPISODE_FILE, allow_pickle=False) as arrays:
            positions.append(arrays["rel_pos"])
            turns.append(arrays["rel_orn"])
    return data_info(seeds, lengths, instructions, subgoals, action_space(positions, turns))
