"""Tell gymnasium of the tasks. What they are made of, ManiSkill above all, is imported when one is made."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

from robocas_ms3.core.after_import import after_import
from robocas_ms3.scenes.task_specs import TASKS, TaskSpec

_log = logging.getLogger(__name__)


def register() -> None:
    """Register the environments of all tasks that are not registered yet, those of other packages as well.

    It happens when this package and gymnasium have been imported, in either order; tasks of a module that is half
    imported then, as it imports this package, follow when it is through.
    """
    from gymnasium.envs.registration import registry  # not above: importing it calls this

    for task in TASKS.values():
        if task.env_id in registry:
            continue
        try:
            registry[task.env_id] = _spec(task)
        except Exception as error:  # an id or numbers that gymnasium does not take; the others are there all the same
            _log.warning("the task %s can't be registered: %s", task.name, error)
    for module in TASKS.unfinished():
        after_import(module, register)


def _spec(task: TaskSpec) -> Any:
    from gymnasium.envs.registration import EnvSpec, WrapperSpec

    limit = WrapperSpec(
        "MSTimeLimit",
        entry_point="mani_skill.utils.registration:TimeLimitWrapper",
        kwargs={"max_episode_steps": task.max_episode_steps},
    )
    return EnvSpec(
        task.env_id,
        entry_point=partial(_make, task.name),
        vector_entry_point=partial(_make_vec, task.env_id),
        max_episode_steps=task.max_episode_steps,
        disable_env_checker=True,  # as ManiSkill: tensors are none of gymnasium's arrays
        additional_wrappers=_OfSingleEnvs([limit]),  # pyright: ignore[reportArgumentType]
    )


class _OfSingleEnvs(list):
    """Wrappers for ``gym.make`` alone.

    ``gym.make_vec`` refuses specs with wrappers, and ours have one, the time limit, of which `make_vec` takes care
    itself. It looks at a deep copy of the spec, ``gym.make`` at the spec itself.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> list:
        return []


def _make(name: str, **kwargs: Any) -> Any:
    from robocas_ms3.tasks.registry import env_class

    return env_class(name)(**kwargs)


def _make_vec(env_id: str, **kwargs: Any) -> Any:
    from robocas_ms3.tasks.vector import make_vec

    return make_vec(env_id, **kwargs)
