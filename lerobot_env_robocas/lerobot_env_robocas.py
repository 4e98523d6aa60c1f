"""Register ``--env.type=robocas``: LeRobot's commands import each distribution named ``lerobot_env_*``."""

from robocas_ms3.evaluation.harness.lerobot import RoboCASEnvConfig

__all__ = ["RoboCASEnvConfig"]
