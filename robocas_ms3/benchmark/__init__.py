"""What the benchmark consists of, declared without a simulator: its tasks."""

from robocas_ms3.benchmark.spec import TaskSpec
from robocas_ms3.benchmark.tasks import TASKS

__all__ = ["TASKS", "TaskSpec"]
