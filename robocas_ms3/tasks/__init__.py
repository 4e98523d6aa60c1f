"""The benchmark's tasks: importing this package registers the environments and the robot."""

import logging

from robocas_ms3.tasks.open_pick import RoboCASOpenPickEnv
from robocas_ms3.tasks.pick import RoboCASPickEnv
from robocas_ms3.tasks.search import RoboCASSearchEnv
from robocas_ms3.tasks.select import RoboCASSelectEnv
from robocas_ms3.tasks.spec import TASKS, TaskSpec
from robocas_ms3.tasks.vector.gymnasium_spec import register_make_vec

for _spec in TASKS.values():
    register_make_vec(_spec.env_id)

# Without a GPU each environment warns that rendering might be disabled, which a renderer on the CPU does as well.
# The blank is in the logger's name.
logging.getLogger("mani_skill ").addFilter(
    lambda record: not record.getMessage().startswith("Requested to use render device")
)

__all__ = ["TASKS", "RoboCASOpenPickEnv", "RoboCASPickEnv", "RoboCASSearchEnv", "RoboCASSelectEnv", "TaskSpec"]
