"""RoboCAS for LeRobot: importing this registers ``--env.type=robocas``, as LeRobot's commands do by themselves."""

from lerobot_env_robocas.config import RoboCASEnvConfig
from lerobot_env_robocas.vector_env import RoboCASVectorEnv

__all__ = ["RoboCASEnvConfig", "RoboCASVectorEnv"]
