"""The benchmark's tasks: importing this package loads the environments and our robots."""

import logging

from robocas_ms3.core.extensions import load
from robocas_ms3.registration import register
from robocas_ms3.robots.table import ROBOTS
from robocas_ms3.scenes.task_specs import TASKS, TaskSpec
from robocas_ms3.tasks.open_pick import RoboCASOpenPickEnv
from robocas_ms3.tasks.pick import RoboCASPickEnv
from robocas_ms3.tasks.registry import env_class
from robocas_ms3.tasks.search import RoboCASSearchEnv
from robocas_ms3.tasks.select import RoboCASSelectEnv

register()
for _name in TASKS.builtin:
    env_class(_name)
for _robot in ROBOTS.builtin.values():
    load(_robot.agent)

# Without a GPU each environment warns that rendering might be disabled, which a renderer on the CPU does as well.
# The blank is in the logger's name.
logging.getLogger("mani_skill ").addFilter(
    lambda record: not record.getMessage().startswith("Requested to use render device")
)

__all__ = ["TASKS", "RoboCASOpenPickEnv", "RoboCASPickEnv", "RoboCASSearchEnv", "RoboCASSelectEnv", "TaskSpec"]
