"""The environments of tasks, told to ManiSkill when they are loaded."""

from __future__ import annotations

from typing import Any

from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.registration import register as tell_mani_skill

from robocas_ms3.core.extensions import load
from robocas_ms3.scenes.task_specs import TASKS


def env_class(name: str) -> Any:
    """The environment of a task.

    Raises:
        ExtensionError: there is no such task, or its environment can't be loaded.
    """
    task = TASKS.find(name)
    env = load(task.env)
    if task.env_id not in REGISTERED_ENVS:
        tell_mani_skill(task.env_id, env, max_episode_steps=task.max_episode_steps)
    return env
