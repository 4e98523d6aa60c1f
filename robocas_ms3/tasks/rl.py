"""Keyword arguments of environments for reinforcement learning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.scenes.config import TaskConfig, load_config_for
from robocas_ms3.scenes.task_specs import TASKS

CONTROL_FREQ = 5  # Hz, the rate for which `pd_ee_delta_pose` is scaled
DRIVING_SECONDS = 30  # additional time if the base drives


def rl_kwargs(task: str, config: str | Path | dict | TaskConfig | None = None) -> dict[str, Any]:
    """Return arguments of ``gym.make`` and `make_vec` for training: states, dense rewards, 5 Hz.

    ``max_episode_steps`` is long enough for a demonstration (docs/rl.md). If the base may drive (``base_motion``),
    actions include the base, and the horizon is longer.

    Args:
        task: name of the task, ``pick``, or of its environment, ``RoboCASPick-v1``.
        config: task configuration; None: the task's default configuration.

    Raises:
        ConfigError: the task or configuration does not exist, or they don't belong together.
    """
    spec = next((spec for spec in TASKS.values() if task in (spec.name, spec.env_id)), None)
    if spec is None:
        known = ", ".join(f"{spec.name} or {spec.env_id}" for spec in TASKS.values())
        raise ConfigError("no such task", where="rl_kwargs", expected=known, found=repr(task))
    drives = load_config_for(spec, config).base_motion
    return {
        **({} if config is None else {"config": config}),
        "obs_mode": "state",
        "reward_mode": "normalized_dense",
        "control_mode": "pd_ee_delta_pose_base" if drives else "pd_ee_delta_pose",
        "sim_config": {"control_freq": CONTROL_FREQ},
        "max_episode_steps": (spec.training_seconds + drives * DRIVING_SECONDS) * CONTROL_FREQ,
        "render_backend": "none",
    }
