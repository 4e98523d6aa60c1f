"""Scenes of the training data of a run, compared with the task configurations of an evaluation."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.strict_model import StrictModel
from robocas_ms3.datasets.sources.episode_source import EpisodeSource
from robocas_ms3.scenes.config import TaskConfig, load_task_config
from robocas_ms3.scenes.lookup import find_objects

_NOT_SCENE = {"task", "description", "target", "language", "objects"}
"""Keys of a task configuration that do not change the scene; objects are compared by their ids."""
_CAMERA_NAMES = {"randomisation.cameras": "with random poses"}
"""Words for readers by setting."""
_MAX_NAMES = 5  # that a message lists


class TrainingScenes(StrictModel):
    """Scenes of the training data of a run; an empty field is unknown.

    Attributes:
        tasks: short names of the tasks.
        objects: asset ids of the objects.
        configs: by name of a task configuration, its values that change the scene, see `select_scene_settings`.
    """

    tasks: list[str] = []
    objects: list[str] = []
    configs: dict[str, dict[str, Any]] = {}

    def list_differences(self, configs: Mapping[str, TaskConfig], cameras: Collection[str]) -> list[str]:
        """List the tasks, scene settings, objects and cameras that the training data lacks.

        Args:
            configs: task configurations of an evaluation, by name.
            cameras: cameras that the policy observes; settings of other cameras are not compared.

        Returns:
            Texts such as ``objects banana, plum``; empty if the training data has everything.
        """
        settings, objects = set[str](), set[str]()
        trained = [_select_cameras(values, cameras) for values in self.configs.values()]
        for config in configs.values():
            values = select_scene_settings(config, cameras)
            changes = [{key for key in {*values, *known} if values.get(key) != known.get(key)} for known in trained]
            settings |= min(changes, key=len, default=set())
            objects |= _object_ids(config) if self.objects else set()
        camera_settings = {key for key in settings if "camera" in key}
        tasks = {config.task for config in configs.values()} if self.tasks else set()
        found = {
            "task": tasks - set(self.tasks),
            "scene settings": settings - camera_settings,
            "objects": objects - set(self.objects),
            "cameras": {_CAMERA_NAMES.get(key, key.removeprefix("cameras.")) for key in camera_settings},
        }
        return [f"{kind} {_join_names(names)}" for kind, names in found.items() if names]

    def summarize(self) -> str:
        """Return the tasks, configurations and objects in one line of text."""
        parts = {"": self.tasks, "in ": list(self.configs), "objects ": self.objects}
        return ", ".join(f"{word}{_join_names(names)}" for word, names in parts.items() if names)


def read_training_scenes(source: EpisodeSource, numbers: Iterable[int]) -> TrainingScenes:
    """Read the scenes of episodes from their ``scene.json``; values that it lacks stay empty.

    numbers: numbers of the episodes.
    """
    tasks, objects, configs, known = set[str](), set[str](), dict[str, dict[str, Any]](), set[str]()
    for number in numbers:
        scene = source.episode(number).scene
        if isinstance(task := scene.get("task"), str):
            tasks.add(task)
        objects |= {str(one["id"]) for one in scene.get("objects") or () if isinstance(one, Mapping) and one.get("id")}
        config = scene.get("config")
        if not isinstance(config, Mapping) or (text := json.dumps(config, sort_keys=True)) in known:
            continue
        known.add(text)
        try:
            settings = select_scene_settings(load_task_config(dict(config)))
        except ConfigError:  # written by a version with other keys
            continue
        if settings not in configs.values():
            configs[name_config(_find_given_config(scene), configs)] = settings
    return TrainingScenes(tasks=sorted(tasks), objects=sorted(objects), configs=configs)


def name_config(given: Any, known: Collection[str]) -> str:
    """Return a name for a task configuration that is not in ``known``.

    ``given``: the argument ``config`` of ``gym.make``: a name, a path, or the values of a configuration.
    """
    name = Path(given).stem if isinstance(given, str) else "configuration"
    return name if name not in known else f"{name}-{len(known) + 1}"


def select_scene_settings(config: TaskConfig, cameras: Collection[str] | None = None) -> dict[str, Any]:
    """Return the values of a task configuration that change the scene or the images.

    Keys: those of the configuration; ``randomisation.KEY``; ``objects.count``; ``static_camera`` and ``cameras.NAME``,
    only for the given ``cameras``. None: all cameras.
    """
    values = config.model_dump(mode="json")
    nested = {"randomisation": values.pop("randomisation"), "cameras": values.pop("cameras", {})}
    settings = {key: value for key, value in values.items() if key not in _NOT_SCENE}
    settings |= {f"{key}.{name}": value for key, part in nested.items() for name, value in part.items() if value}
    settings["objects.count"] = config.objects.count
    return settings if cameras is None else _select_cameras(settings, cameras)


def _select_cameras(settings: Mapping[str, Any], cameras: Collection[str]) -> dict[str, Any]:
    """Return the settings without those of unused cameras.

    Without cameras, the result has no settings of lights and room either.
    """
    unused = {"static_camera"} - set(cameras)
    if not cameras:
        unused |= {"lights", "room", "randomisation.lights", "randomisation.room", "randomisation.finishes"}
        unused |= {"randomisation.cameras"}
    return {
        key: value
        for key, value in settings.items()
        if key not in unused and (not key.startswith("cameras.") or key.removeprefix("cameras.") in cameras)
    }


def _object_ids(config: TaskConfig) -> set[str]:
    """Return the asset ids of the objects of a configuration; ids of other packs as in ``objects.ids``."""
    try:
        return set(find_objects(load_pack("builtin"), config))
    except ConfigError:  # ids of another pack
        return set() if config.objects.ids == "all" else {str(name) for name in config.objects.ids}


def _find_given_config(scene: Mapping[str, Any]) -> Any:
    info = scene.get("env_info")
    kwargs = info.get("env_kwargs") if isinstance(info, Mapping) else None
    return kwargs.get("config") if isinstance(kwargs, Mapping) else None


def _join_names(names: Collection[str]) -> str:
    ordered = sorted(names)
    more = len(ordered) - _MAX_NAMES
    return ", ".join(ordered[:_MAX_NAMES]) + (f" and {more} more" if more > 0 else "")
