"""Brings a dataset in upstream's format, made elsewhere, into the schema's form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robocas_ms3
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import json_text, replacing_folder, write_json
from robocas_ms3.core.strict import parse
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.manage.eef import about_z
from robocas_ms3.datasets.manage.findings import EMBEDDINGS, EpisodeImport
from robocas_ms3.datasets.manage.parts import schema_version
from robocas_ms3.datasets.manage.reading import read_episode
from robocas_ms3.datasets.manage.survey import Survey, read_info
from robocas_ms3.datasets.sources.protocol import CameraModel
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.records import EpisodesRecord
from robocas_ms3.datasets.sources.tolerant import SPECS, EpisodeArrays
from robocas_ms3.datasets.writing.episode_folder import write_cameras
from robocas_ms3.datasets.writing.info import write_info
from robocas_ms3.datasets.writing.output import Placer, dataset_output
from robocas_ms3.datasets.writing.plan import dataset_settings

Embed = Callable[[list[str]], NDArray[np.float32]]
REPORT_FILE = "import_report.json"
SPLIT_RULE = "as in the dataset it was imported from; episodes that were not listed there as by the writer's rule"


def import_robocas(
    surveyed: Survey,
    out: Path,
    *,
    link: bool = False,
    embed: Embed | None = None,
    overwrite: bool = False,
    on_start: Callable[[int], None] | None = None,
    on_episode: Callable[[int], None] | None = None,
) -> int:
    """Write a dataset of the episodes that can be taken; they keep their numbers. Gives how many were there already.

    Pictures are copied or linked, arrays and camera files written anew; nothing of upstream's folder changes. Called
    again after a kill at any moment, it continues.

    Args:
        surveyed: of `survey.survey`.
        out: folder of the new dataset; ``import_report.json`` goes there too.
        link: hard links to the pictures where the file system allows; else copies.
        embed: texts -> (N, 384), for episodes without embeddings; None: these stay without, and so do all.
        overwrite: start again, and replace a dataset that exists.
        on_start: called with the number of episodes to write.
        on_episode: called with the number of each.

    Raises:
        DatasetError: nothing can be taken, or the output is the input.
        OutputExistsError: ``out`` is another dataset, or none.
    """
    if not surveyed.taken or surveyed.pictures is None:
        raise DatasetError(
            "no episode can be taken",
            where=surveyed.root,
            found=f"{count_of(surveyed.episodes, 'episode')}, nothing whole",
            fix="robocas import-robocas without --out says what is wrong.",
        )
    dataset = Dataset(surveyed.root)
    info, _ = read_info(dataset)
    embedded = surveyed.embeddings or embed is not None
    plan = _plan(dataset, surveyed, embedded)
    with dataset_output(out, plan, inputs=[surveyed.root], overwrite=overwrite):
        placer = Placer(link)
        missing = [n for n in surveyed.taken if not (out / schema.episode_folder(n)).is_dir()]
        if on_start:
            on_start(len(missing))
        for number in missing:
            read = read_episode(
                dataset, number, info, rate_hz=surveyed.rate_hz, turn_eef=surveyed.turn_eef, pictures=False
            )
            if not read.usable:
                where = surveyed.root / schema.episode_folder(number)
                raise DatasetError("this episode changed meanwhile", where=where)
            taken = replace(read, stored=_embedded(read, embedded, embed))
            with replacing_folder(out / schema.episode_folder(number)) as folder:
                _write(folder, dataset.episode(number), taken, surveyed, placer)
            if on_episode:
                on_episode(number)
        write_json(out / REPORT_FILE, surveyed.as_json())
        write_info(out, (info.get("train_eps", []), info.get("val_eps", [])))
    return len(surveyed.taken) - len(missing)


def _plan(dataset: Dataset, surveyed: Survey, embedded: bool) -> dict[str, Any]:
    assert surveyed.pictures is not None
    unknown = dict.fromkeys(("trajectory", "trajectory_episode", "seed", "success", "target", "recording"))
    parse(EpisodesRecord, dataset.settings, DatasetError, where=dataset.root / schema.CONVERSION_FILE)
    before = dataset.settings.get("episodes", {})  # of one that is ours
    name = surveyed.root.resolve().name
    episodes = {
        str(n): {**unknown, **before.get(str(n), {}), "from": {"dataset": name, "episode": n}} for n in surveyed.taken
    }
    return {
        "format": "robocas",
        "schema_version": schema.SCHEMA_VERSION,
        "made_with": {"robocas_ms3": robocas_ms3.__version__},
        **dataset_settings(surveyed.rate_hz, surveyed.pictures, embedded),
        "split": SPLIT_RULE,
        "source": {"format": _format(dataset), "dataset": name},
        "episodes": episodes,
    }


def _format(dataset: Dataset) -> str:
    return f"robocas v{schema_version(dataset)}"


def _embedded(read: EpisodeImport, wanted: bool, embed: Embed | None) -> EpisodeArrays:
    """The arrays of an episode with their embeddings, or without."""
    stored = read.stored
    if not wanted:
        return replace(stored, arrays={key: array for key, array in stored.arrays.items() if key not in EMBEDDINGS})
    if read.embedded:
        return stored
    assert embed is not None
    made = {
        "language_embedding": embed([str(stored.arrays["language_goal"])])[0],
        "step_goal_embs": embed(stored.arrays["step_lang_goals"].tolist()),
    }
    sources = {"language_embedding": "language_goal", "step_goal_embs": "step_lang_goals"}
    return replace(stored, arrays={**stored.arrays, **made}, derived={**stored.derived, **sources})


def _write(folder: Path, episode: Episode, taken: EpisodeImport, surveyed: Survey, placer: Placer) -> None:
    assert surveyed.pictures is not None
    pictures = surveyed.pictures
    cameras = {
        camera: CameraModel(
            np.asarray(episode.intrinsic(camera), dtype=np.float64),
            np.asarray(episode.camera_in_parent(camera), dtype=np.float64),
        )
        for camera in pictures.cameras
    }
    if taken.turn_deg:
        gripper = cameras["gripper_camera"]
        pose = about_z(-taken.turn_deg) @ gripper.camera_in_parent
        cameras["gripper_camera"] = CameraModel(gripper.intrinsic, pose)
    for camera in pictures.cameras:
        for kind in pictures.kinds:
            (folder / camera / kind).mkdir(parents=True)
            for step in range(taken.stored.steps):
                source = episode.image_path(camera, kind, step)
                placer.file(source, schema.image_path(folder, camera, kind, step, pictures.image_format))
    write_cameras(folder, cameras)
    arrays: dict[str, Any] = {key: taken.stored.arrays[key] for key in SPECS if key in taken.stored.arrays}
    np.savez(folder / schema.EPISODE_FILE, **arrays)
    text = json_text(_scene(episode, taken, surveyed), episode.folder, indent=1, error=DatasetError)
    (folder / schema.SCENE_FILE).write_text(text + "\n", encoding="utf-8")


def _scene(episode: Episode, taken: EpisodeImport, surveyed: Survey) -> dict[str, Any]:
    """``scene.json``: nearly all of it is not known, unless the episode said it already."""
    assert episode.dataset is not None
    before = episode.scene if episode.scene.get("schema_version") == schema.SCHEMA_VERSION else {}
    source = {
        "recording": None,
        **(before.get("source") or {}),
        "format": _format(episode.dataset),
        "dataset": surveyed.root.resolve().name,
        "episode": taken.number,
        "derived": taken.stored.derived,
        "missing": taken.missing,
        "mended": taken.mended,
    }
    known = {"schema_version": schema.SCHEMA_VERSION, "rate_hz": float(surveyed.rate_hz), "source": source}
    return {key: known.get(key, before.get(key)) for key in schema.SCENE}
