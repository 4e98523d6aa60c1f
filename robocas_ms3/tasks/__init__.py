"""The tasks of the benchmark. Importing this package registers environments and robots with ManiSkill."""

import logging
from typing import Any

from mani_skill.utils.registration import REGISTERED_ENVS, register

from robocas_ms3.core.extensions import import_object
from robocas_ms3.robots.registry import ROBOTS
from robocas_ms3.scenes.task_specs import TASKS, TaskSpec
from robocas_ms3.tasks.open_pick import RoboCASOpenPickEnv
from robocas_ms3.tasks.pick import RoboCASPickEnv
from robocas_ms3.tasks.search import RoboCASSearchEnv
from robocas_ms3.tasks.select import RoboCASSelectEnv


def register_env_class(name: str) -> Any:
    """Register the environment of a task with ManiSkill and gymnasium, and return its class.

    Raises:
        ExtensionError: the task is unknown, or its environment can't be loaded.
    """
    task = TASKS.find(name)
    env = import_object(task.env)
    if task.env_id not in REGISTERED_ENVS:
        register(task.env_id, env, max_episode_steps=task.max_episode_steps)
    return env


for _name in TASKS.builtin:
    register_env_class(_name)
for _robot in ROBOTS.builtin.values():
    import_object(_robot.agent)

# Without a GPU ManiSkill warns for each environment that rendering might be disabled; software renderers work.
# The name of ManiSkill's logger ends with a blank.
logging.getLogger("mani_skill ").addFilter(
    lambda record: not record.getMessage().startswith("Requested to use render device")
)

__all__ = [
    "TASKS",
    "RoboCASOpenPickEnv",
    "RoboCASPickEnv",
    "RoboCASSearchEnv",
    "RoboCASSelectEnv",
    "TaskSpec",
    "register_env_class",
]
