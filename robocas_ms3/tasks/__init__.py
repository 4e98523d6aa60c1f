"""The benchmark's tasks: importing this package registers the environments and the robot."""

from robocas_ms3.tasks.pick import RoboCASPickEnv
from robocas_ms3.tasks.spec import TASKS, TaskSpec

__all__ = ["TASKS", "RoboCASPickEnv", "TaskSpec"]
