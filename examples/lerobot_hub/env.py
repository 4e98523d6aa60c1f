"""RoboCAS for LeRobot's EnvHub: upload this file as ``env.py`` to a repository of the Hugging Face Hub.

Loading it requires robocas_ms3 with the extra ``lerobot-env``::

    from lerobot.envs import make_env
    envs = make_env("USER/REPOSITORY", n_envs=2, trust_remote_code=True)    # {"pick": {0: vector environment}}
"""

from dataclasses import fields

from lerobot.envs import EnvConfig  # pyright: ignore[reportMissingImports]

from robocas_ms3.evaluation.harness.lerobot import RoboCASEnvConfig

SETTINGS = {"task": "pick", "protocol": "ms3-v1"}


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Make the vector environments of each task.

    Args:
        n_envs: number of environments, which run at the same time.
        use_async_envs: ignored, because envs on a CPU run in processes anyway.
        cfg: an object whose attributes override `SETTINGS`, named as in `RoboCASEnvConfig`. Attributes that are None or
            that equal LeRobot's defaults (``fps=30``) are ignored.

    Returns:
        ``{task: {0: vector environment}}``.
    """
    names = {field.name for field in fields(RoboCASEnvConfig)} - {"features", "features_map"}
    defaults = {field.name: field.default for field in fields(EnvConfig)}
    given = {name: getattr(cfg, name, None) for name in names}
    changed = {name: value for name, value in given.items() if value is not None and value != defaults.get(name)}
    settings = {**SETTINGS, **changed}
    return RoboCASEnvConfig(**settings).create_envs(n_envs, use_async_envs)
