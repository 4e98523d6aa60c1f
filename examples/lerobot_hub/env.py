"""RoboCAS for LeRobot's EnvHub: upload this file as ``env.py`` to a repository of the Hugging Face Hub.

Whoever loads it needs robocas_ms3 with the extra ``lerobot-env``::

    from lerobot.envs import make_env
    envs = make_env("USER/REPOSITORY", n_envs=2, trust_remote_code=True)    # {"pick": {0: vector environment}}
"""

from dataclasses import fields

from robocas_ms3.evaluation.harness.lerobot import RoboCASEnvConfig

SETTINGS = {"task": "pick", "protocol": "ms3-v1"}


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Make the vector environments of each task.

    Args:
        n_envs: episodes at a time.
        use_async_envs: ignored, because envs on a CPU run in processes anyway.
        cfg: an object whose attributes are settings of `RoboCASEnvConfig`; None: `SETTINGS`.

    Returns:
        ``{task: {0: vector environment}}``.
    """
    settings = SETTINGS
    if cfg is not None:
        names = {one.name for one in fields(RoboCASEnvConfig)} - {"features", "features_map"}
        settings = {name: getattr(cfg, name) for name in names if hasattr(cfg, name)}
    return RoboCASEnvConfig(**settings).create_envs(n_envs, use_async_envs)
