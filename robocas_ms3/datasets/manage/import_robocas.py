"""Import of datasets in the format of RoboCAS-v0: episodes are repaired and written by the schema."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_folder, write_json
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import format_count
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.conversion.data_info import write_data_info
from robocas_ms3.datasets.conversion.episode_folder import write_episode_files
from robocas_ms3.datasets.conversion.episode_plan import make_settings
from robocas_ms3.datasets.manage.copy_episodes import (
    CopyOptions,
    FileCopier,
    check_no_overlap,
    find_schema_version,
    make_copied_header,
    open_dataset_output,
)
from robocas_ms3.datasets.manage.repairs import EMBEDDINGS, ImportedEpisode
from robocas_ms3.datasets.manage.survey import Survey, read_data_info, read_imported_episode
from robocas_ms3.datasets.sources.arrays import SPECS, EpisodeArrays, add_embeddings
from robocas_ms3.datasets.sources.file_models import SCENE_KEYS, EpisodesRecord
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.robots.camera_models import CameraModel

Embed = Callable[[list[str]], NDArray[np.float32]]
REPORT_FILE = "import_report.json"
SPLIT_RULE = "as in the imported dataset; episodes that it does not list are split by seed"


def import_robocas(survey: Survey, out: Path, *, embed: Embed | None = None, options: CopyOptions | None = None) -> int:
    """Import the importable episodes of a survey into a new dataset.

    Return the number of episodes that existed already. Episodes keep their numbers. Images are copied or hard-linked;
    arrays, camera files and ``import_report.json`` are written. The input does not change. The same call continues an
    interrupted import. ``embed`` computes missing embeddings.

    Raises:
        DatasetError: no episode can be imported, or the output overlaps the input.
        OutputExistsError: ``out`` is a dataset that a different call wrote (unless ``options.overwrite``), or a
            folder with other content.
    """
    if not survey.importable or survey.image_options is None:
        found = f"{format_count(survey.episodes, 'episode')}, none importable"
        fix = "Run robocas import-robocas without --out for the findings."
        raise DatasetError("no episode can be imported", where=survey.root, found=found, fix=fix)
    dataset, options = Dataset(survey.root), options or CopyOptions(link=False)
    info, _ = read_data_info(dataset)
    embedded = survey.embeddings or embed is not None
    check_no_overlap(out, [survey.root])
    with open_dataset_output(out, _make_conversion_record(dataset, survey, embedded), options.overwrite):
        copier = FileCopier(options.link)
        missing = [n for n in survey.importable if not (out / schema.episode_folder(n)).is_dir()]
        if options.on_start:
            options.on_start(len(missing))
        for number in missing:
            episode = read_imported_episode(dataset, number, info, survey.rate_hz, survey.turn_eef)
            if not episode.is_importable:
                where = survey.root / schema.episode_folder(number)
                fix = "Run the same command again."
                raise DatasetError("this episode has changed during the import", where=where, fix=fix)
            episode.stored = _set_embeddings(episode, embedded, embed)
            with atomic_folder(out / schema.episode_folder(number)) as folder:
                _write_episode(folder, dataset.episode(number), episode, survey, copier)
            if options.on_episode:
                options.on_episode(number)
        write_json(out / REPORT_FILE, survey.as_json())
        write_data_info(out, (info.get("train_eps", []), info.get("val_eps", [])))
    return len(survey.importable) - len(missing)


def _make_conversion_record(dataset: Dataset, survey: Survey, embedded: bool) -> dict[str, Any]:
    assert survey.image_options is not None
    unknown = dict.fromkeys(("trajectory", "trajectory_episode", "seed", "success", "target", "recording"))
    parse(EpisodesRecord, dataset.settings, DatasetError, where=dataset.root / schema.CONVERSION_FILE)
    known = dataset.settings.get("episodes", {})
    name = survey.root.resolve().name
    episodes = {
        str(n): {**unknown, **known.get(str(n), {}), "from": {"dataset": name, "episode": n}} for n in survey.importable
    }
    return {
        **make_copied_header(make_settings(survey.rate_hz, survey.image_options, embedded), SPLIT_RULE),
        "source": {"format": f"robocas v{find_schema_version(dataset)}", "dataset": name},
        "episodes": episodes,
    }


def _set_embeddings(episode: ImportedEpisode, wanted: bool, embed: Embed | None) -> EpisodeArrays:
    stored = episode.stored
    if not wanted:
        return replace(stored, arrays={key: array for key, array in stored.arrays.items() if key not in EMBEDDINGS})
    if episode.has_embeddings:
        return stored
    assert embed is not None
    derived = {"language_embedding": "language_goal", "step_goal_embs": "step_lang_goals"}
    return replace(stored, arrays=add_embeddings(stored.arrays, embed), derived={**stored.derived, **derived})


def _write_episode(folder: Path, source: Episode, episode: ImportedEpisode, survey: Survey, copier: FileCopier) -> None:
    image_options, stored = survey.image_options, episode.stored
    assert image_options is not None
    cameras: dict[str, CameraModel] = {}
    for camera in image_options.cameras:
        model = source.camera(camera)
        back = np.eye(4)
        if model.parent == "ee":
            back[:3, :3] = Rotation.from_euler("z", -episode.eef_rotation_deg, degrees=True).as_matrix()
        cameras[camera] = CameraModel(
            np.asarray(model.intrinsic, dtype=np.float64),
            back @ np.asarray(model.camera_in_parent, dtype=np.float64),
            model.parent,
            back @ np.asarray(model.true_camera_in_parent, dtype=np.float64),
        )
        for kind in image_options.kinds:
            (folder / camera / kind).mkdir(parents=True)
            for step in range(stored.steps):
                target = schema.image_path(folder, camera, kind, step, image_options.image_format)
                copier.copy_file(source.image_path(camera, kind, step), target)
    arrays = {key: stored.arrays[key] for key in SPECS if key in stored.arrays}
    write_episode_files(folder, arrays, cameras, _make_scene(source, episode, survey))


def _make_scene(source: Episode, episode: ImportedEpisode, survey: Survey) -> dict[str, Any]:
    """Make the content of ``scene.json``.

    Without such a file in the input, most values are None (unknown).
    """
    previous = source.scene if source.scene.get("schema_version") == schema.SCHEMA_VERSION else {}
    wanted = (spec.name for spec in schema.EPISODE_INFO if not (spec.embedding or spec.optional))
    repaired = (found for found in episode.findings if found.outcome == "repaired")
    made = {
        "recording": None,
        **(previous.get("source") or {}),
        "format": f"robocas v{find_schema_version(source.dataset)}",
        "dataset": survey.root.resolve().name,
        "episode": episode.number,
        "derived": episode.stored.derived,
        "missing": [key for key in wanted if key not in episode.stored.arrays],
        "repaired": [f"{found.violation.where.split('/', 1)[1]}: {found.problem}" for found in repaired],
    }
    known = {"schema_version": schema.SCHEMA_VERSION, "rate_hz": float(survey.rate_hz), "source": made}
    return {key: known.get(key, previous.get(key)) for key in SCENE_KEYS}
