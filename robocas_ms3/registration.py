"""Registration of the tasks with gymnasium. ManiSkill is imported when an environment is made."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec

from robocas_ms3.scenes.task_specs import TASKS, TaskSpec

_log = logging.getLogger(__name__)


def register_envs() -> None:
    """Register the environments of all tasks, also those of other packages; keep ids that are registered already."""
    for task in TASKS.values():
        if task.env_id in gym.registry:
            continue
        try:
            _register(task)
        except Exception as error:  # of another package: an id or numbers that gymnasium refuses
            _log.warning("the environment of the task %s can't be registered: %s", task.name, error)


def _register(task: TaskSpec) -> None:
    """Register one task as ``mani_skill.utils.registration.register_env`` does: time limits return tensors."""
    limit = WrapperSpec(
        "MSTimeLimit",
        entry_point="mani_skill.utils.registration:TimeLimitWrapper",
        kwargs={"max_episode_steps": task.max_episode_steps},
    )
    gym.register(
        task.env_id,
        entry_point=partial(_make, task.name),
        # gym.make_vec refuses environments with wrappers; without this it would wrap batched environments once more
        vector_entry_point="robocas_ms3.tasks.vector:make_vec",
        max_episode_steps=task.max_episode_steps,
        disable_env_checker=True,  # it accepts NumPy arrays, but no tensors
        additional_wrappers=(limit,),
    )


def _make(name: str, **kwargs: Any) -> Any:
    from robocas_ms3.tasks import register_env_class

    return register_env_class(name)(**kwargs)
