"""The benchmark's tasks: importing this package registers the environments and the robot."""

from robocas_ms3.tasks.open_pick import RoboCASOpenPickEnv
from robocas_ms3.tasks.pick import RoboCASPickEnv
from robocas_ms3.tasks.search import RoboCASSearchEnv
from robocas_ms3.tasks.select import RoboCASSelectEnv
from robocas_ms3.tasks.spec import TASKS, TaskSpec

__all__ = ["TASKS", "RoboCASOpenPickEnv", "RoboCASPickEnv", "RoboCASSearchEnv", "RoboCASSelectEnv", "TaskSpec"]
