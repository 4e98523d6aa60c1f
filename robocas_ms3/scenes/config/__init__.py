"""Task configurations: validated models of the YAML files in ``task_configs/``."""

from robocas_ms3.scenes.config.load import bundled_configs, load_config_for, load_task_config
from robocas_ms3.scenes.config.task import TaskConfig

__all__ = ["TaskConfig", "load_config_for", "load_task_config", "bundled_configs"]
