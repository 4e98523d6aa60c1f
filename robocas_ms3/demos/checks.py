"""What is checked before a run begins, so that a mistake is one line and leaves no trace."""

from __future__ import annotations

import json
from dataclasses import MISSING, fields
from typing import Any

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.strict import check_number
from robocas_ms3.demos.episode import EpisodeSettings
from robocas_ms3.demos.recordings.seeds import GREATEST_SEED
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.planning.backends import BACKENDS
from robocas_ms3.robots.table import find_robot
from robocas_ms3.scenes.config import load_config_of
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.task_specs import SIM_FREQ, TASKS

WEIGHTS = "after_policy_weights"
"""Key of ``run.json``: hash of the weights of ``after_policy``."""


def check_limits(episode_seconds: float, memory_gb: float) -> None:
    """Check what an episode may take.

    Raises:
        RobocasError: it is nothing.
    """
    check_number("episode_seconds", episode_seconds, 1)
    check_number("memory_gb", memory_gb, 0.1)


def check_arguments(
    settings: EpisodeSettings, *, episodes: int, first_seed: int, jobs: int, acts_first: bool = False
) -> None:
    """Check what a run is asked for, before anything is written.

    Args:
        settings: of the episodes.
        episodes: how many.
        first_seed: of their scenes.
        jobs: worker processes.
        acts_first: whether there is something that has ``settings.after_policy`` act.

    Raises:
        RobocasError: a number is out of its range, the task can't run the configuration, or there is no such planner,
            robot or pack.
    """
    check_number("episodes", episodes, 1)
    check_number("seed", first_seed, 0, GREATEST_SEED)
    check_number("jobs", jobs, 1)
    check_number("max_attempts", settings.max_attempts, 1)
    check_number("control_freq", settings.control_freq, 1, SIM_FREQ)
    if SIM_FREQ % settings.control_freq:
        raise RobocasError(
            "the control rate has to divide that of physics",
            where="control_freq",
            expected=f"one of {', '.join(str(f) for f in range(1, SIM_FREQ + 1) if SIM_FREQ % f == 0)}",
            found=settings.control_freq,
        )
    check_number("noisy_trials", settings.noisy_trials, 0)
    check_number("noisy_failures", settings.noisy_failures, 0)
    check_number("noise_mm", settings.noise_mm, 0)
    check_number("noise_deg", settings.noise_deg, 0)
    check_number("replay_rate", settings.replay_rate, 0, settings.control_freq)
    if settings.replay_rate and (settings.control_freq % settings.replay_rate or SIM_FREQ % settings.replay_rate):
        raise RobocasError(
            "the rate at which actions are tried again has to divide the control rate and that of physics",
            where="replay_rate",
            expected=f"a divisor of {settings.control_freq}, or 0 for no trial",
            found=settings.replay_rate,
        )
    least, most = settings.after_steps
    check_number("after_steps", least, 1)
    check_number("after_steps", most, least)
    if bool(settings.after_policy) != acts_first:
        raise RobocasError("a policy that acts first and what has it act go together", where="after_policy")
    BACKENDS.find(settings.planner, where="planner")
    robot = find_robot(settings.robot)
    config = load_config_of(TASKS[settings.task], settings.config)
    SceneModel.load(config, load_pack(settings.pack), load_pack("builtin"), robot=robot.description)


def upgrade_run(record: dict[str, Any]) -> dict[str, Any]:
    """Return a ``run.json`` with defaults for what older versions of the package did not record."""
    defaults = {one.name: one.default for one in fields(EpisodeSettings) if one.default is not MISSING}
    settings = record["settings"]
    if isinstance(settings, dict):
        settings = {**json.loads(json.dumps(defaults)), **settings}
    return {"versions": versions(), **record, "settings": settings}
