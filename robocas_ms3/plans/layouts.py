"""Layouts of a plan's seeds: made one by one, joined in the end as an environment's ``layouts`` takes them."""

from __future__ import annotations

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.demos.episode import EpisodeSettings
from robocas_ms3.plans.units import Task
from robocas_ms3.robots.table import find_robot
from robocas_ms3.scenes.bank import layout_bank
from robocas_ms3.scenes.config import load_config_of
from robocas_ms3.scenes.frozen import write_frozen
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.task_specs import TASKS


class LayoutMaker:
    """Makes layouts of one configuration, the ones that its environment has.

    Args:
        settings: of the configuration's episodes.
    """

    def __init__(self, settings: EpisodeSettings) -> None:
        config, robot = load_config_of(TASKS[settings.task], settings.config), find_robot(settings.robot)
        model = SceneModel.load(config, load_pack(settings.pack), load_pack("builtin"), robot=robot.description)
        self._names = model.object_pack.objects
        self._layouts = layout_bank(model, settings.layouts)

    def write(self, task: Task) -> None:
        """Write a seed's layout.

        Raises:
            LayoutError: it has none.
        """
        write_frozen(task.layout, self._names, {task.seed: self._layouts(task.seed, task.seed)})
