"""Task configurations: strict models of the YAML files in ``task_configs/``."""

from robocas_ms3.scenes.config.load import load_config_of, load_task_config, shipped_configs
from robocas_ms3.scenes.config.task import TaskConfig

__all__ = ["TaskConfig", "load_config_of", "load_task_config", "shipped_configs"]
