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
from robocas_ms3.datasets.conversion.data_info import write_info
from robocas_ms3.datasets.conversion.episode_folder import write_episode_files
from robocas_ms3.datasets.conversion.episode_plan import dataset_settings
from robocas_ms3.datasets.manage.copy_episodes import (
    CopyOptions,
    FilePlacer,
    check_apart,
    copied_header,
    dataset_output,
    schema_version,
)
from robocas_ms3.datasets.manage.repairs import EMBEDDINGS, ImportedEpisode
from robocas_ms3.datasets.manage.survey import Survey, read_episode, read_info
from robocas_ms3.datasets.sources.arrays import SPECS, EpisodeArrays, add_embeddings
from robocas_ms3.datasets.sources.episode_source import CameraModel
from robocas_ms3.datasets.sources.file_models import SCENE_KEYS, EpisodesRecord
from robocas_ms3.datasets.sources.reader import Dataset, Episode

Embed = Callable[[list[str]], NDArray[np.float32]]
REPORT_FILE = "import_report.json"
SPLIT_RULE = "as in the imported dataset; episodes that it does not list are split by seed"


def import_robocas(
    surveyed: Survey, out: Path, *, embed: Embed | None = None, options: CopyOptions | None = None
) -> int:
    """Write a dataset of the importable episodes; return the number of episodes that existed already.

    Episodes keep their numbers. Images are copied or linked; arrays, camera files and a report are written. The source
    does not change. The same call continues an interrupted import. ``embed`` computes missing embeddings.

    Raises:
        DatasetError: no episode can be imported, or the output overlaps the input.
        OutputExistsError: ``out`` is another dataset, or not a dataset.
    """
    if not surveyed.importable or surveyed.image_options is None:
        found = f"{format_count(surveyed.episodes, 'episode')}, none importable"
        fix = "Run robocas import-robocas without --out for the findings."
        raise DatasetError("no episode can be imported", where=surveyed.root, found=found, fix=fix)
    dataset, options = Dataset(surveyed.root), options or CopyOptions(link=False)
    info, _ = read_info(dataset)
    embedded = surveyed.embeddings or embed is not None
    check_apart(out, [surveyed.root])
    with dataset_output(out, _record(dataset, surveyed, embedded), options.overwrite):
        placer = FilePlacer(options.link)
        missing = [n for n in surveyed.importable if not (out / schema.episode_folder(n)).is_dir()]
        if options.on_start:
            options.on_start(len(missing))
        for number in missing:
            episode = read_episode(dataset, number, info, surveyed.rate_hz, surveyed.turn_eef)
            if not episode.usable:
                where = surveyed.root / schema.episode_folder(number)
                raise DatasetError("this episode changed during the import", where=where)
            episode.stored = _embedded(episode, embedded, embed)
            with atomic_folder(out / schema.episode_folder(number)) as folder:
                _write(folder, dataset.episode(number), episode, surveyed, placer)
            if options.on_episode:
                options.on_episode(number)
        write_json(out / REPORT_FILE, surveyed.as_json())
        write_info(out, (info.get("train_eps", []), info.get("val_eps", [])))
    return len(surveyed.importable) - len(missing)


def _record(dataset: Dataset, surveyed: Survey, embedded: bool) -> dict[str, Any]:
    assert surveyed.image_options is not None
    unknown = dict.fromkeys(("trajectory", "trajectory_episode", "seed", "success", "target", "recording"))
    parse(EpisodesRecord, dataset.settings, DatasetError, where=dataset.root / schema.CONVERSION_FILE)
    known = dataset.settings.get("episodes", {})
    name = surveyed.root.resolve().name
    episodes = {
        str(n): {**unknown, **known.get(str(n), {}), "from": {"dataset": name, "episode": n}}
        for n in surveyed.importable
    }
    return {
        **copied_header(dataset_settings(surveyed.rate_hz, surveyed.image_options, embedded), SPLIT_RULE),
        "source": {"format": f"robocas v{schema_version(dataset)}", "dataset": name},
        "episodes": episodes,
    }


def _embedded(episode: ImportedEpisode, wanted: bool, embed: Embed | None) -> EpisodeArrays:
    stored = episode.stored
    if not wanted:
        return replace(stored, arrays={key: array for key, array in stored.arrays.items() if key not in EMBEDDINGS})
    if episode.embedded:
        return stored
    assert embed is not None
    derived = {"language_embedding": "language_goal", "step_goal_embs": "step_lang_goals"}
    return replace(stored, arrays=add_embeddings(stored.arrays, embed), derived={**stored.derived, **derived})


def _write(folder: Path, source: Episode, episode: ImportedEpisode, surveyed: Survey, placer: FilePlacer) -> None:
    image_options, stored = surveyed.image_options, episode.stored
    assert image_options is not None
    cameras: dict[str, CameraModel] = {}
    for camera in image_options.cameras:
        model = source.camera(camera)
        pose = np.asarray(model.camera_in_parent, dtype=np.float64)
        if model.parent == "ee" and episode.turn_deg:
            back = Rotation.from_euler("z", -episode.turn_deg, degrees=True).as_matrix()
            pose = np.vstack([back @ pose[:3], pose[3]])
        cameras[camera] = CameraModel(np.asarray(model.intrinsic, dtype=np.float64), pose, model.parent)
        for kind in image_options.kinds:
            (folder / camera / kind).mkdir(parents=True)
            for step in range(stored.steps):
                target = schema.image_path(folder, camera, kind, step, image_options.image_format)
                placer.place(source.image_path(camera, kind, step), target)
    arrays = {key: stored.arrays[key] for key in SPECS if key in stored.arrays}
    write_episode_files(folder, arrays, cameras, _scene(source, episode, surveyed))


def _scene(source: Episode, episode: ImportedEpisode, surveyed: Survey) -> dict[str, Any]:
    """Return the content of ``scene.json``; values are unknown unless the episode has such a file."""
    previous = source.scene if source.scene.get("schema_version") == schema.SCHEMA_VERSION else {}
    wanted = (spec.name for spec in schema.EPISODE_INFO if not spec.embedding)
    repaired = (found for found in episode.findings if found.outcome == "repaired")
    made = {
        "recording": None,
        **(previous.get("source") or {}),
        "format": f"robocas v{schema_version(source.dataset)}",
        "dataset": surveyed.root.resolve().name,
        "episode": episode.number,
        "derived": episode.stored.derived,
        "missing": [key for key in wanted if key not in episode.stored.arrays],
        "repaired": [f"{found.violation.where.split('/', 1)[1]}: {found.problem}" for found in repaired],
    }
    known = {"schema_version": schema.SCHEMA_VERSION, "rate_hz": float(surveyed.rate_hz), "source": made}
    return {key: known.get(key, previous.get(key)) for key in SCENE_KEYS}
